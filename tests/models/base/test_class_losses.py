"""Class losses with targets of quality, on the heads of points and of Gaussians."""

from types import SimpleNamespace

import pytest
import torch
from head_cases import CLASSES, GSMAP, HEAD, LANES, bev, build_head, losses_of

from gsmap.models.base.class_losses import DistanceQuality, QualityClassLoss
from gsmap.models.base.pairs import GroundTruth

FOCAL = {"type": "mmdet.FocalLoss", "use_sigmoid": True, "loss_weight": 2.0}
DISTANCE = {"type": "DistanceQuality"}
QUALITIES = {
    "distance": DISTANCE,
    "errors": {"type": "ErrorQuality"},
    "masks": {"type": "MaskQuality"},
    "product": {"type": "ProductQuality", "qualities": [DISTANCE, {"type": "MaskQuality"}]},
}


def by_quality(quality: dict = DISTANCE, **settings) -> dict:
    return {"type": "QualityClassLoss", "quality": quality, "first_layer": FOCAL, **settings}


class FixedQuality(torch.nn.Module):
    """A quality that does not depend on the prediction."""

    def __init__(self, value: float) -> None:
        super().__init__()
        self.value = value

    def forward(self, pairs):
        return torch.full(pairs.gt_labels.shape, self.value)


def loss_and_pairs(scores: list, label: int, query: int) -> tuple:
    """The loss of a matched query in the second of two layers of one query each."""
    loss = QualityClassLoss(DISTANCE, FOCAL)
    logits = torch.tensor([scores], requires_grad=True)
    pairs = SimpleNamespace(
        num_layers=2,
        predictions=SimpleNamespace(scores=logits),
        samples=torch.tensor([0]),
        query_inds=torch.tensor([query]),
        gt_labels=torch.tensor([label]),
        pred_pts=torch.full((1, 20, 2), 0.5) + torch.tensor([0.02, 0.03]),
        gt_pts=torch.full((1, 20, 2), 0.5),
        query_labels=lambda: torch.full((1, len(scores)), -1),
    )
    return loss, pairs, logits


def test_the_values_of_a_matched_query_and_of_one_without_a_match():
    """By hand: q = exp(-5 (0.02 + 0.03)) = 0.778801."""
    rows = [[0.0, 0.0, 0.0], [0.3, -1.2, -2.0]]
    loss, pairs, logits = loss_and_pairs(rows, label=0, query=1)
    assert DistanceQuality()(pairs).item() == pytest.approx(0.778801, abs=1e-6)
    values = loss(pairs)
    expected = torch.tensor([0.025922, 0.014107, 0.001804])
    torch.testing.assert_close(values[0, 1] / 2, expected, atol=1e-6, rtol=0)
    values.sum().backward()
    assert logits.grad.abs().min() > 0

    rows[1] = [-3.0, 0.5, -1.0]
    loss, pairs, _ = loss_and_pairs(rows, label=0, query=0)
    assert loss(pairs)[0, 1].sum().item() / 2 == pytest.approx(0.400179, abs=1e-6)


@pytest.mark.parametrize("quality", QUALITIES.values(), ids=QUALITIES)
def test_every_quality_trains_a_head_and_gets_no_gradient(quality):
    config = HEAD if quality is DISTANCE else GSMAP
    head = build_head(config, loss_cls=by_quality(quality)).train()
    plain = build_head(config).train()
    losses, expected = losses_of(head, LANES), losses_of(plain, LANES)
    torch.testing.assert_close(losses["d0.loss_cls"], expected["d0.loss_cls"])
    assert losses["loss_cls"] != expected["loss_cls"]
    losses["loss_cls"].backward()
    assert head.cls_branches[1][-1].weight.grad.abs().sum() > 0
    # the class loss reaches points by their states alone, never by the target
    assert all(branch[-1].weight.grad is None for branch in head.reference.branches[1:])


def test_qualities_are_between_0_and_1_and_1_for_the_truth():
    head = build_head(GSMAP).train()
    outputs = head(bev())
    truths = GroundTruth([LANES], head.reference, head.masks)
    pairs = head.match(outputs, truths, [{"token": "a"}])
    for config in QUALITIES.values():
        quality = build_head(GSMAP, loss_cls=by_quality(config)).loss_cls.quality
        values = quality(pairs)
        assert values.shape == pairs.gt_labels.shape
        assert not values.requires_grad
        assert (values > 0).all()
        assert (values <= 1).all()
    exact = SimpleNamespace(pred_pts=pairs.gt_pts, gt_pts=pairs.gt_pts)
    assert torch.equal(DistanceQuality()(exact), torch.ones(len(pairs.gt_labels)))


def test_defaults_are_those_of_the_release():
    loss = QualityClassLoss(DISTANCE, FOCAL)
    assert (loss.beta, loss.loss_weight, loss.classes) == (2.0, 2.0, None)
    assert loss.quality.scale == 5.0


def test_a_certain_score_of_a_perfect_line_costs_nothing():
    loss, pairs, _ = loss_and_pairs([[0.0, 0.0, 0.0], [40.0, -40.0, -40.0]], 0, 1)
    loss.quality = FixedQuality(1.0)
    assert loss(pairs)[0, 1].sum() == 0


def test_other_classes_keep_a_target_of_1():
    loss, pairs, _ = loss_and_pairs([[0.0] * 3, [0.3, -1.2, -2.0]], label=0, query=1)
    loss.classes = (1,)
    assert loss.targets(pairs)[0, 1].tolist() == [1, 0, 0]
    loss.classes = (0, 1)
    assert loss.targets(pairs)[0, 1].tolist() == pytest.approx([0.778801, 0, 0], abs=1e-6)


def test_what_does_not_fit_a_head_is_refused():
    with pytest.raises(ValueError, match=r"loss_cls\.classes must be indices of"):
        build_head(HEAD, loss_cls=by_quality(classes=[len(CLASSES)]))
    with pytest.raises(ValueError, match="MaskQuality needs Gaussians"):
        build_head(HEAD, loss_cls=by_quality(QUALITIES["product"]))
