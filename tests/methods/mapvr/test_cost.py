import numpy as np
import pytest
import torch
from mmengine.structures import InstanceData

from gsmap.models.mapvr.cost import RenderedDiceCost
from gsmap.models.mapvr.losses import ElementRenderer
from gsmap.ops.soft_iou import dice_loss


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
