import pytest
import torch
from mmengine.structures import InstanceData

from gsmap.models.maptr.cost import OrderedPointsCost, order_distances

LINE = torch.tensor([[0.1, 0.1], [0.2, 0.1], [0.3, 0.1]])


def test_distance_to_every_order_by_hand():
    orders = torch.stack([LINE, LINE.flip(0)])[None]  # (1, 2, 3, 2)
    # the same line: 0 forward; backward the ends are 0.2 off each
    torch.testing.assert_close(order_distances(LINE[None], orders), torch.tensor([[[0.0, 0.4]]]))


def test_cost_takes_the_closest_order_and_leaves_padding_alone():
    padding = torch.full((3, 2), -333.0)
    near = torch.stack([LINE, LINE.flip(0), padding])
    far = torch.stack([LINE + 0.5, LINE.flip(0) + 0.5, padding])
    gt = InstanceData(labels=torch.tensor([0, 0]), pts_shifts=torch.stack([near, far]))
    prediction = InstanceData(pts=torch.stack([LINE.flip(0), LINE + 0.5]))
    cost = OrderedPointsCost(weight=2.0)(prediction, gt)
    # 3 points x 2 coordinates x 0.5 apart, twice
    torch.testing.assert_close(cost, torch.tensor([[0.0, 6.0], [6.0, 0.0]]))


def test_another_number_of_points_is_refused():
    with pytest.raises(ValueError, match="same number of points in the head and in the pipeline"):
        order_distances(torch.rand(2, 20, 2), torch.rand(1, 2, 10, 2))
