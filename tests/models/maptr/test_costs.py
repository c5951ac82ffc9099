import numpy as np
import pytest
import torch
from mmdet3d.registry import TASK_UTILS
from mmengine.structures import InstanceData

from gsmap.models.gsmap.cost import IoUCost
from gsmap.models.maptr.matching import OrderedPointsCost, order_distances
from gsmap.models.mapvr.cost import RenderedDiceCost
from gsmap.models.mapvr.losses import ElementRenderer
from gsmap.ops.soft_iou import dice_loss

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


def test_the_overlapping_pair_wins():
    """Two predictions, each on the other's ground truth: cost 0 off the diagonal, 1 on it."""
    masks = torch.zeros(2, 4, 5)
    masks[0, 0], masks[1, 3] = 1, 1
    cost = TASK_UTILS.build({"type": "mmdet3d.IoUCost", "weight": 2.0})
    assert isinstance(cost, IoUCost)
    values = cost(InstanceData(rasters=masks), InstanceData(rasters=masks.flip(0)))
    torch.testing.assert_close(values, torch.tensor([[2.0, 0.0], [0.0, 2.0]]))


def test_the_dice_of_the_rendered_masks_can_take_its_place():
    masks = torch.rand(2, 4, 5, generator=torch.Generator().manual_seed(0))
    values = IoUCost(weight=2.0, kind="dice")(
        InstanceData(rasters=masks), InstanceData(rasters=masks.flip(0))
    )
    overlap = (masks[0] * masks[1]).sum()
    expected = 2 * (1 - (2 * overlap + 1) / (masks.sum() + 1))
    torch.testing.assert_close(values[0, 0], expected)
    with pytest.raises(ValueError, match="kind must be 'iou' or 'dice', got 'area'"):
        IoUCost(kind="area")


def test_missing_rasters_are_named():
    with pytest.raises(ValueError, match=r"needs gt_instances\.rasters"):
        IoUCost()(InstanceData(rasters=torch.zeros(1, 2, 2)), InstanceData(labels=torch.zeros(1)))


def test_pairs_are_rendered_as_the_ground_truths_class():
    """A ring costs nothing against itself in either class, and its area differs from its edge."""
    ring = torch.tensor([[[0.2, 0.2], [0.8, 0.2], [0.8, 0.8], [0.2, 0.8], [0.2, 0.2]]])
    gts = InstanceData(labels=torch.tensor([2, 0]), first_pts=ring.repeat(2, 1, 1))
    cost = RenderedDiceCost(10.0, (32, 32), polygon_classes=(2,))(InstanceData(pts=ring), gts)
    renderer = ElementRenderer((32, 32))
    area, edge = renderer.render(gts.first_pts, torch.tensor([True, False]))
    assert area[16, 16] > 0.99
    assert edge[16, 16] < 1e-6
    expected = torch.stack([dice_loss(m[None], m[None])[0] for m in (area, edge)])
    torch.testing.assert_close(cost[0], 10 * expected)


def test_dice_cost_is_least_for_the_annotated_order():
    points = torch.rand(3, 6, 2, generator=torch.Generator().manual_seed(0))
    gts = InstanceData(labels=torch.tensor([1, 0]), first_pts=points[:2])
    values = RenderedDiceCost(size=(24, 16))(InstanceData(pts=points), gts)
    assert values[:, 0].argmin() == 0
    assert values[:, 1].argmin() == 1


@pytest.mark.parametrize("case", ["closed", "many"])
def test_dice_cost_equals_the_golden_one(golden_dir, case):
    arrays = np.load(golden_dir / "models/mapvr_dice_A.npz")
    names = ("cost_pred", "gt", "labels", "cost_w10")
    preds, gts, labels, expected = (torch.from_numpy(arrays[f"{case}_{name}"]) for name in names)
    cost = RenderedDiceCost()(InstanceData(pts=preds), InstanceData(first_pts=gts, labels=labels))
    torch.testing.assert_close(cost, expected, rtol=1e-4, atol=1e-5)
