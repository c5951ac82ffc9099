import json
import math

import numpy as np
import pytest
import torch
from predictions import pairs_of

from gsmap.models.mapvr.losses import ElementRenderer, RenderedDiceLoss
from gsmap.ops.soft_iou import dice_loss, pairwise_dice_loss


def rendered(loss, pred, gt, labels):
    """Return the mean loss of pairs of points."""
    count = max(len(pred), 1)
    pairs = pairs_of(pred_pts=pred, gt_first_pts=gt, gt_labels=labels, avg_factor=count)
    return loss(pairs)


@pytest.fixture(params=["closed", "many"])
def golden(request, golden_dir):
    arrays = np.load(golden_dir / "models/mapvr_dice_A.npz")
    prefix = request.param + "_"
    names = [name for name in arrays.files if name.startswith(prefix)]
    return {name[len(prefix) :]: torch.from_numpy(arrays[name]) for name in names}


def test_dice_worked_by_hand():
    """1 - (2 (1 * 0.5) + 1) / (1.5 + 1 + 1) = 1 - 2 / 3.5"""
    pred, target = torch.tensor([[[1.0, 0.5, 0.0]]]), torch.tensor([[[0.5, 0.0, 0.5]]])
    torch.testing.assert_close(dice_loss(pred, target), torch.tensor([1 - 2 / 3.5]))
    torch.testing.assert_close(pairwise_dice_loss(pred, target), torch.tensor([[1 - 2 / 3.5]]))


def test_loss_and_true_gradient_equal_the_golden_ones(golden):
    pred = golden["pred"].requires_grad_()
    loss = rendered(RenderedDiceLoss(), pred, golden["gt"], golden["labels"])
    loss.backward()
    torch.testing.assert_close(loss.double(), golden["loss_w15"], rtol=1e-4, atol=0)
    difference = (pred.grad - golden["grad_analytic"]).norm()
    assert difference < 1e-4 * golden["grad_analytic"].norm()


def test_without_polygon_classes_all_are_lines():
    points, labels = torch.rand(2, 5, 2), torch.tensor([0, 1])
    renderer = ElementRenderer((16, 8), polygon_classes=())
    assert not renderer.is_polygon(labels).any()
    lines = ElementRenderer((16, 8)).render(points, torch.zeros(2, dtype=torch.bool))
    torch.testing.assert_close(renderer.render(points, renderer.is_polygon(labels)), lines)


@pytest.mark.parametrize("distance", ["squared", "plain"])
def test_softness_is_in_the_unit_of_the_distance(distance):
    """A line on row 2 of 8, seen from row 5: 3 pixels, or 9 square pixels."""
    line = torch.tensor([[[0.0, 0.25], [1.0, 0.25]]])
    renderer = ElementRenderer((8, 8), line_softness=3.0, distance=distance)
    mask = renderer.render(line, torch.tensor([False]))[0]
    expected = math.exp(-3 if distance == "squared" else -1)
    assert mask[5, 4].item() == pytest.approx(expected, rel=0.03)  # the way back is 0.01 nearer


def test_gradient_of_the_plain_distances_loss():
    generator = torch.Generator().manual_seed(1)
    pred, gt = torch.rand(2, 2, 4, 2, dtype=torch.float64, generator=generator)
    loss = RenderedDiceLoss(size=(9, 7), distance="plain")
    labels = torch.tensor([0, 1])
    assert torch.autograd.gradcheck(
        lambda p: rendered(loss, p, gt, labels), [pred.requires_grad_()]
    )


@pytest.mark.parametrize("case", ["closed", "many"])
def test_loss_on_a_models_predictions_equals_the_golden_one(golden_dir, case):
    models = golden_dir / "models"
    golden = np.load(models / f"mapvr_headloss_{case}_A.npz")
    preds = np.load(models / "maptr_r50_forward_reduced_A.npz")["all_pts_preds"][:, 0]
    gts_m = np.load(models / f"maptr_loss_{case}_A.npz")["gt_fixed_pts"]
    gts = (torch.from_numpy(gts_m) + torch.tensor([15.0, 30.0])) / torch.tensor([30.0, 60.0])
    annotated = json.loads((models / "gt_A.json").read_text())["sets"][case]
    labels = torch.tensor([element["label"] for element in annotated])
    for layer, pred in enumerate(torch.from_numpy(preds)):
        query, gt, _ = golden[f"match_l{layer}"].T
        value = rendered(RenderedDiceLoss(), pred[query], gts[gt], labels[gt])
        name = f"loss/d{layer}.loss_rendered_mask" if layer < 5 else "loss/loss_rendered_mask"
        assert value.item() == pytest.approx(float(golden[name]), rel=1e-4)


def test_nothing_matched_gives_zero_with_a_gradient():
    pred = torch.zeros(0, 20, 2, requires_grad=True)
    loss = rendered(
        RenderedDiceLoss(), pred, torch.zeros(0, 20, 2), torch.zeros(0, dtype=torch.long)
    )
    loss.backward()
    assert loss.item() == 0
    assert pred.grad.shape == pred.shape


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"line_softness": 0}, "softness must be > 0, got 0 and 4.0"),
        ({"line_softness": math.nan}, "softness must be > 0, got nan and 4.0"),
        ({"size": (0, 4)}, r"size must be rows and columns, both >= 1, got \(0, 4\)"),
        ({"polygon_classes": (-1,)}, r"polygon_classes must be >= 0, got \(-1,\)"),
        ({"distance": "cubed"}, "distance must be one of .* got 'cubed'"),
    ],
)
def test_bad_settings_are_named(change, match):
    with pytest.raises(ValueError, match=match):
        RenderedDiceLoss(**change)
