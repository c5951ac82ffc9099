import pytest
import torch

pytest.importorskip("mmdet3d")

from mmdet3d.registry import TASK_UTILS
from mmengine.structures import InstanceData

from gsmap.models.losses.dice import ElementRenderer, rendered_dice_cost
from gsmap.models.task_modules.raster_costs import IoUCost, RenderedDiceCost


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


def test_dice_cost_renders_the_annotated_order_as_its_class():
    points = torch.rand(3, 6, 2, generator=torch.Generator().manual_seed(0))
    gts = InstanceData(labels=torch.tensor([1, 0]), first_pts=points[:2])
    values = RenderedDiceCost(weight=10.0, size=(24, 16))(InstanceData(pts=points), gts)
    renderer = ElementRenderer((24, 16))
    expected = rendered_dice_cost(points, points[:2], gts.labels, renderer)
    torch.testing.assert_close(values, 10 * expected)
    assert values[:, 0].argmin() == 0
    assert values[:, 1].argmin() == 1
