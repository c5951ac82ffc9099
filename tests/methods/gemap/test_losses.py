import math

import numpy as np
import pytest
import torch
from predictions import pairs_of

from gsmap.models.gemap.losses import (
    EuclideanLoss,
    euclidean_relation_loss,
    euclidean_shape_loss,
    shape_features,
)

LOW, SIZE = torch.tensor([-15.0, -30.0]), torch.tensor([30.0, 60.0])  # the golden files' range


def loss_of(loss, pred, target, counts):
    """Return the loss of pairs of points, so many of each sample."""
    return loss(pairs_of(pred_pts=pred, gt_pts=target, counts=counts))


def read(path):
    with np.load(path) as arrays:
        return {name: torch.from_numpy(arrays[name]) for name in arrays.files}


def regular(points):
    """Return a ring of edges of 0.1, each turned by 360 / points degrees from the one before."""
    angles = torch.arange(points).double() * 2 * math.pi / points
    steps = 0.1 * torch.stack([angles.cos(), angles.sin()], -1)
    return steps.cumsum(0)[None]


def test_features_of_a_square_by_hand():
    """Edges of 0.1, each a left turn of 90 degrees; the last point's edge leads to the first."""
    lengths, cosines, sines = shape_features(regular(4))
    torch.testing.assert_close(lengths, torch.full_like(lengths, 0.1))
    torch.testing.assert_close(cosines, torch.zeros_like(cosines))
    torch.testing.assert_close(sines, torch.full_like(sines, 0.01 / (0.01 + 1e-6)))


def test_shape_loss_of_a_square_and_a_hexagon_by_hand():
    """Edges differ by 0.05, cosines of 90 and 60 degrees by 0.5, sines by 1 - sqrt(3) / 2."""
    square = regular(4).repeat(1, 3, 1)  # 12 points: three rounds
    hexagon = 1.5 * regular(6).repeat(1, 2, 1)
    expected = 0.05 + 0.5 + 1 - math.sqrt(3) / 2
    value = euclidean_shape_loss(square, hexagon).item()
    assert value == pytest.approx(expected, abs=2e-4)  # 1e-6 beside a product of lengths of 0.01


def test_relation_loss_by_hand():
    """Two elements of two points: the second is turned by 90 degrees around the first's end.

    pred      target       Of 4 x 4 pairs of points, 2 x 2 count.
    . . . d   . . . .      Distances: a-c and b-c stay 2 and 1, a-d goes from sqrt 5 to 3,
    a b c .   a b c d      b-d from sqrt 2 to 2. Cosines of all four edges go from 0 to +-1, sines
                           from +-1 to 0.
    """
    first = torch.tensor([[0.0, 0.0], [1.0, 0.0]])
    up, along = torch.tensor([[2.0, 0.0], [2.0, 1.0]]), torch.tensor([[2.0, 0.0], [3.0, 0.0]])
    pred, target = torch.stack([first, up]), torch.stack([first, along])
    expected = (3 - math.sqrt(5) + 2 - math.sqrt(2) + 4 + 4) / 16
    value = euclidean_relation_loss(pred, target, [2]).item()
    assert value == pytest.approx(expected, abs=1e-5)  # 1e-6 beside a product of lengths of 1
    assert euclidean_relation_loss(pred, target, [1, 1]).item() == 0
    twice = euclidean_relation_loss(pred.repeat(2, 1, 1), target.repeat(2, 1, 1), [2, 0, 2])
    assert twice.item() == pytest.approx(2 * expected, abs=1e-5)


def test_loss_and_gradient_equal_the_golden_ones(golden_dir):
    golden = read(golden_dir / "models/gemap_geoloss_A.npz")
    matched = golden["labels"] < 3
    counts = matched.unflatten(0, (2, 50)).sum(1).tolist()
    leaf = golden["pred"].requires_grad_()
    pred, target = leaf[matched], ((golden["target_m"] - LOW) / SIZE)[matched]
    shape = euclidean_shape_loss(pred, target)
    relation = euclidean_relation_loss(pred, target, counts)
    loss = loss_of(EuclideanLoss(), pred, target, counts)
    loss.backward()
    for value, name in (
        (shape, "intra_unweighted"),
        (relation, "inter_unweighted"),
        (loss, "loss"),
    ):
        torch.testing.assert_close(value.double(), golden[name], rtol=1e-4, atol=0)
    assert (leaf.grad - golden["grad"]).norm() < 1e-3 * golden["grad"].norm()


@pytest.mark.parametrize("case", ["closed", "many"])
def test_loss_on_a_models_predictions_equals_the_golden_one(golden_dir, case):
    """The target is the ground truth in the order that was matched."""
    models = golden_dir / "models"
    golden = read(models / f"gemap_headloss_{case}_A.npz")
    preds = read(models / "gemap_simple_r50_forward_reduced_A.npz")["all_pts_preds"][:, 0]
    shifts = (read(models / f"maptr_loss_{case}_A.npz")["gt_shift_pts"] - LOW) / SIZE
    for layer, pred in enumerate(preds):
        query, gt, shift = golden[f"match_l{layer}"].T
        value = loss_of(EuclideanLoss(), pred[query], shifts[gt, shift], [len(query)])
        name = f"loss/d{layer}.loss_geo_2" if layer < 5 else "loss/loss_geo_2"
        torch.testing.assert_close(value.double(), golden[name], rtol=1e-4, atol=0)


def test_gradients():
    generator = torch.Generator().manual_seed(0)
    pred, target = torch.rand(2, 5, 4, 2, dtype=torch.float64, generator=generator)
    pred.requires_grad_()
    loss = EuclideanLoss(1.0, 0.7, 1.3)
    assert torch.autograd.gradcheck(lambda p: loss_of(loss, p, target, [2, 0, 3]), [pred])


def test_repeated_points_keep_the_gradient_finite():
    pred = torch.zeros(2, 4, 2, requires_grad=True)
    loss_of(EuclideanLoss(), pred, torch.rand(2, 4, 2), [2]).backward()
    assert torch.isfinite(pred.grad).all()


@pytest.mark.parametrize("counts", [[], [0, 0]])
def test_nothing_matched_gives_zero_with_a_gradient(counts):
    pred = torch.zeros(0, 20, 2, requires_grad=True)
    value = loss_of(EuclideanLoss(), pred, torch.zeros(0, 20, 2), counts)
    value.backward()
    assert value.item() == 0
    assert pred.grad.shape == pred.shape


def test_bad_arguments_are_named():
    pred = torch.rand(3, 4, 2)
    with pytest.raises(ValueError, match=r"counts must add up to 3 matches, got \[1, 1\]"):
        loss_of(EuclideanLoss(), pred, pred, [1, 1])
    for loss in (euclidean_shape_loss, lambda p, t: euclidean_relation_loss(p, t, [3])):
        with pytest.raises(ValueError, match=r"target must have shape \(3, 4, 2\) of pred"):
            loss(pred, pred[:2])


def test_it_has_no_weight_of_each_class():
    with pytest.raises(TypeError, match="EuclideanLoss is no sum over pairs: give one loss_weight"):
        EuclideanLoss(loss_weight=(1.0, 5.0, 3.0))
