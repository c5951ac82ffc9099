import math
from dataclasses import dataclass

import pytest
import torch
from mmengine.structures import InstanceData
from model_cases import build_small, small_config, straight_elements
from predictions import predicted, stacked

from gsmap.models.base.decoder import Decoded
from gsmap.models.base.losses import MapLoss

LINE = ((-6.0, -12.0), (6.0, 12.0))
NUM = 8  # queries


@pytest.fixture(scope="module")
def head():
    return build_small().eval().map_head


def outputs_with(pts_m, head, scores=None, layers=1):
    """Return a head's outputs in which the first queries predict given points in metres."""
    pts = torch.full((layers, 1, NUM, 20, 2), 0.99)
    pts[:, 0, : len(pts_m)] = head.grid.norm_from_metres(pts_m)
    if scores is None:
        scores = torch.zeros(layers, 1, NUM, 3)
    return predicted(head, scores, pts)


def focal(logit, target):
    """Sigmoid focal loss of one entry, alpha 0.25, gamma 2."""
    p = 1 / (1 + math.exp(-logit))
    if target:
        return -0.25 * (1 - p) ** 2 * math.log(p)
    return -0.75 * p**2 * math.log(1 - p)


def test_losses_by_hand(head):
    gt = straight_elements(LINE, labels=[2])
    # the line in reverse, shifted by 1.5 m in x (0.05 of 30 m), the same direction
    predicted = gt.pts[0].flip(0) + torch.tensor([1.5, 0.0])
    losses = head.loss_by_feat(outputs_with(predicted[None], head), [gt], [{}])
    assert losses["loss_pts"].item() == pytest.approx(5 * 20 * 0.05, rel=1e-4)
    assert losses["loss_dir"].item() == pytest.approx(0.0, abs=1e-6)
    entries = NUM * 3
    expected = 2 * (focal(0, True) + (entries - 1) * focal(0, False))
    assert losses["loss_cls"].item() == pytest.approx(expected, rel=1e-5)


def test_the_direction_is_compared_in_metres(head):
    gt = straight_elements(((0.0, 0.0), (6.0, 0.0)))
    predicted = straight_elements(((0.0, 0.0), (6.0, 6.0))).pts
    losses = head.loss_by_feat(outputs_with(predicted, head), [gt], [{}])
    # 45 degrees in metres on 19 edges; in normalised units it would be 27 degrees
    assert losses["loss_dir"].item() == pytest.approx(0.005 * 19 * (1 - math.sqrt(0.5)), rel=1e-4)


def test_the_divisor_is_the_number_of_matched_elements_in_the_batch(head):
    one, three = straight_elements(LINE), straight_elements(LINE, *[((3.0, 0), (3.0, 9))] * 2)
    outputs = stacked(outputs_with(torch.cat([one.pts + 1.0]), head))
    both = predicted(head, outputs.scores.repeat(1, 2, 1, 1), outputs.pts.repeat(1, 2, 1, 1, 1))
    gts = head.prepare_gts([one, three])
    pairs = head.match(both, gts, [{}, {}])
    assert pairs.avg_factor.item() == 4.0
    assert pairs.gt_pts.shape == (4, 20, 2)
    assert (pairs.query_labels() >= 0).sum(1).tolist() == [1, 3]


def test_only_the_last_layer_has_plain_names(head):
    gt = straight_elements(LINE)
    losses = head.loss_by_feat(outputs_with(gt.pts, head, layers=3), [gt], [{}])
    assert list(losses) == [
        f"{prefix}{name}"
        for prefix in ("d0.", "d1.", "")
        for name in ("loss_cls", "loss_pts", "loss_dir")
    ]


def test_no_element_leaves_the_class_loss_alone(head):
    outputs = outputs_with(torch.zeros(0, 20, 2), head)
    losses = head.loss_by_feat(outputs, [straight_elements()], [{}])
    expected = 2 * NUM * 3 * focal(0, False)
    assert losses["loss_cls"].item() == pytest.approx(expected, rel=1e-5)
    assert losses["loss_pts"].item() == losses["loss_dir"].item() == 0.0


def test_queries_are_sums_of_instance_and_point(head):
    position, content = head.queries()
    both = head.instance_embedding.weight[3] + head.pts_embedding.weight[7]
    torch.testing.assert_close(torch.cat([position[3 * 20 + 7], content[3 * 20 + 7]]), both)


def test_class_scores_come_from_the_mean_point(head):
    torch.manual_seed(0)
    with torch.no_grad():
        outputs = head({"bev_feats": torch.randn(2, 16, 12, 6)})
    mean = stacked(outputs).point_states[1].mean(2)
    with torch.no_grad():
        torch.testing.assert_close(stacked(outputs).scores[1], head.cls_branches[1](mean))
    assert stacked(outputs).pts.shape == (2, 2, 8, 20, 2)
    assert stacked(outputs).references.shape == (2, 2, 8, 20, 2)


def test_every_class_starts_improbable():
    bias = build_small().map_head.cls_branches[0][-1].bias
    torch.testing.assert_close(bias.sigmoid(), torch.full((3,), 0.01))


@dataclass(eq=False)
class Numbered(Decoded):
    """What a decoder returns that numbers its queries. (B, N)"""

    number: torch.Tensor


class QueryNumberLoss(MapLoss):
    """Adds the numbers of the matched queries, and their ground truths."""

    name = "new"

    def values(self, pairs):
        numbers = pairs.of_queries(pairs.predictions.decoded.number)
        return numbers + 10 * pairs.gt_labels + 100 * pairs.samples


def test_a_loss_reads_what_a_decoder_adds_of_the_matched_pairs():
    head = small_config().map_head
    head.losses = [{"type": QueryNumberLoss}]
    head = build_small(map_head=head).map_head
    gt = straight_elements(LINE, labels=[2])
    (layer,) = outputs_with(torch.cat([gt.pts + 5, gt.pts]), head)
    points = layer.pts.repeat(2, 1, 1, 1)
    decoded = Numbered(points, points, points, torch.arange(NUM).repeat(2, 1))
    layer = head.predictions(torch.zeros(2, NUM, 3), decoded, None)
    losses = head.loss_by_feat([layer], [gt, gt], [{}, {}])
    assert losses["loss_new"].item() == (21 + 121) / 2  # query 1, class 2, in both samples
    assert "loss_pts" not in losses


@pytest.mark.parametrize(
    ("method", "options"),
    [
        ("values", {}),
        ("values", {"loss_weight": [1.0, 2.0, 3.0]}),
        ("forward", {}),
        ("by_layer", {}),
        ("by_layer", {"last_layer_only": True}),
    ],
)
def test_a_loss_of_another_shape_is_named(method, options):
    kind = type("OddLoss", (QueryNumberLoss,), {method: lambda self, pairs: torch.zeros(3)})
    head = small_config().map_head
    head.losses = [{"type": kind, **options}]
    head = build_small(map_head=head).map_head
    gt = straight_elements(LINE, labels=[2])
    with pytest.raises(ValueError, match=r" must .* got the shape \((1, )?3,?\)"):
        head.loss_by_feat(outputs_with(gt.pts, head), [gt], [{}])


def test_the_class_loss_needs_no_compiled_op(head, monkeypatch):
    def refuse(*_, **__):
        raise RuntimeError("mmcv was built without CUDA")

    monkeypatch.setattr("mmdet.models.losses.focal_loss.sigmoid_focal_loss", refuse)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)  # where mmdet would call it
    gt = straight_elements(LINE, labels=[1])
    scores = torch.full((1, 1, NUM, 3), 0.3)
    losses = head.loss_by_feat(outputs_with(gt.pts, head, scores), [gt], [{}])
    expected = 2 * (focal(0.3, True) + (NUM * 3 - 1) * focal(0.3, False))
    assert losses["loss_cls"].item() == pytest.approx(expected, rel=1e-5)


def test_a_head_gets_grid_and_classes_from_the_detector(head):
    assert head.grid.extent_m == head.coder.grid.extent_m == (30.0, 60.0)
    assert head.masks.grid.extent_m == (30.0, 60.0)
    assert len(head.classes) == head.cls_branches[0][-1].out_features == 3


def test_predictions_are_instance_data_in_metres(head):
    gt = straight_elements(LINE)
    scores = torch.full((1, 1, NUM, 3), -5.0)
    scores[0, 0, 0, 1] = 3.0
    (found,) = head.predict_by_feat(outputs_with(gt.pts, head, scores), [{}])
    assert isinstance(found, InstanceData)
    assert found.labels_3d[0] == 1
    torch.testing.assert_close(found.scores_3d[0], torch.tensor(3.0).sigmoid())
    torch.testing.assert_close(found.pts[0], gt.pts[0], atol=1e-5, rtol=1e-5)
