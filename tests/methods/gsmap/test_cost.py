import pytest
import torch
from mmdet3d.registry import TASK_UTILS
from mmengine.structures import InstanceData

from gsmap.models.gsmap.cost import IoUCost


def truth(masks: torch.Tensor, labels: tuple[int, ...] = (0, 1)) -> InstanceData:
    """Return what the cost reads of two ground truths."""
    return InstanceData(cost_masks=masks, labels=torch.tensor(labels))


def test_the_overlapping_pair_wins():
    """Two predictions, each on the other's ground truth: cost 0 off the diagonal, 1 on it."""
    masks = torch.zeros(2, 4, 5)
    masks[0, 0], masks[1, 3] = 1, 1
    cost = TASK_UTILS.build({"type": "mmdet3d.IoUCost", "weight": 2.0})
    assert isinstance(cost, IoUCost)
    values = cost(InstanceData(cost_masks=masks), truth(masks.flip(0)))
    torch.testing.assert_close(values, torch.tensor([[2.0, 0.0], [0.0, 2.0]]))


def test_the_dice_of_the_rendered_masks_can_take_its_place():
    masks = torch.rand(2, 4, 5, generator=torch.Generator().manual_seed(0))
    values = IoUCost(weight=2.0, kind="dice")(InstanceData(cost_masks=masks), truth(masks.flip(0)))
    overlap = (masks[0] * masks[1]).sum()
    expected = 2 * (1 - (2 * overlap + 1) / (masks.sum() + 1))
    torch.testing.assert_close(values[0, 0], expected)
    with pytest.raises(ValueError, match="kind must be 'iou' or 'dice', got 'area'"):
        IoUCost(kind="area")


def test_each_class_has_its_own_weight():
    masks = torch.zeros(2, 4, 5)
    masks[0, 0], masks[1, 3] = 1, 1
    values = IoUCost(weight=(10.0, 2.0, 7.0))(
        InstanceData(cost_masks=masks), truth(masks.flip(0), labels=(2, 1))
    )
    torch.testing.assert_close(values, torch.tensor([[7.0, 0.0], [0.0, 2.0]]))
