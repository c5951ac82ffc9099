from types import SimpleNamespace

import pytest
import torch
from mmengine.structures import InstanceData

from gsmap.models.base.decoder import Decoded
from gsmap.models.base.matching import MapAssigner
from gsmap.models.base.pairs import GroundTruth, Predictions

LINE = torch.tensor([[0.1, 0.1], [0.2, 0.1], [0.3, 0.1]])
NORMALISED = SimpleNamespace(coords=2, norm=lambda points: points)  # a reference


def make_assigner(*costs):
    return MapAssigner(costs or [{"type": "OrderedPointsCost", "weight": 5.0}])


def elements(*lines):
    """Return a sample's ground truth; each line has two orders."""
    orders = [torch.stack([line, line.flip(0)]) for line in lines]
    shifts = torch.stack(orders) if orders else torch.zeros(0, 2, 3, 2)
    labels = torch.zeros(len(lines), dtype=torch.long)
    return InstanceData(labels_3d=labels, pts_shifts=shifts)


def ground_truth(*lines):
    return GroundTruth([elements(*lines)], NORMALISED, None)


def layer_of(samples, scores):
    """Return the predictions of a layer from the lines of each sample."""
    points = torch.stack([torch.stack(lines) for lines in samples])
    return Predictions(scores, Decoded(points, points, points), None, NORMALISED, None)


def predictions(*lines, scores=None):
    scores = torch.zeros(len(lines), 3) if scores is None else scores
    return layer_of([lines], scores[None])


def assign(assigner, pred, truth, repeats=1, token="a"):
    """Return the match of the one layer of one sample. (M,) each"""
    matches = assigner.assign(pred, truth, [{"token": token}], repeats)
    assert matches.counts == [matches.rows.shape[1]]
    assert torch.equal(matches.rows, matches.gt_inds)
    return SimpleNamespace(**{key: value[0] for key, value in matches._asdict().items()})


def test_each_ground_truth_gets_its_closest_prediction_in_its_order():
    pred = predictions(LINE + 0.6, LINE.flip(0) + 0.3, LINE + 0.01)
    match = assign(make_assigner(), pred, ground_truth(LINE, LINE + 0.3))
    assert match.query_inds.tolist() == [1, 2]
    assert match.gt_inds.tolist() == [1, 0]
    assert match.order_inds.tolist() == [1, 0]


def test_the_sum_of_costs_decides_not_each_ground_truth_alone():
    # both ground truths are closest to prediction 0; giving it to the second costs less in all
    pred = predictions(LINE, LINE + 0.2)
    match = assign(make_assigner(), pred, ground_truth(LINE + 0.02, LINE - 0.01))
    assert match.gt_inds.tolist() == [1, 0]


def test_repeated_ground_truth_gets_its_closest_predictions():
    pred = predictions(LINE + 0.01, LINE.flip(0) + 0.31, LINE + 0.6, LINE, LINE + 0.3)
    match = assign(make_assigner(), pred, ground_truth(LINE, LINE + 0.3), repeats=2)
    assert match.query_inds.tolist() == [0, 1, 3, 4]
    assert match.gt_inds.tolist() == [0, 1, 0, 1]
    assert match.order_inds.tolist() == [0, 1, 0, 0]


def test_the_class_cost_breaks_ties():
    scores = torch.tensor([[-5.0, 0.0, 0.0], [5.0, 0.0, 0.0]])
    costs = [{"type": "mmdet.FocalLossCost", "weight": 2.0}, {"type": "OrderedPointsCost"}]
    pred = predictions(LINE, LINE, scores=scores)
    match = assign(make_assigner(*costs), pred, ground_truth(LINE))
    assert match.query_inds.tolist() == [1]


def test_no_ground_truth_and_more_ground_truth_than_queries():
    none = assign(make_assigner(), predictions(LINE), ground_truth())
    assert len(none.query_inds) == 0
    match = assign(make_assigner(), predictions(LINE), ground_truth(LINE + 0.5, LINE))
    assert match.gt_inds.tolist() == [1]


def test_all_layers_and_samples_at_once_are_matched_as_each_alone():
    """Two layers of three samples, of which one has no elements and one more than queries."""
    near, far = LINE + 0.02, LINE + 0.5
    scores = torch.zeros(3, 2, 3)
    layers = [
        layer_of([(far, near), (near, far), (far, near)], scores),
        layer_of([(near, far), (near, far), (LINE, near)], scores),
    ]
    truth = GroundTruth([elements(LINE), elements(), elements(LINE, far, near)], NORMALISED, None)
    joined = Predictions.join(layers)
    matches = make_assigner().assign(joined, truth, [{}] * 3)
    assert matches.counts == [1, 0, 2]
    assert matches.samples.tolist() == [[0, 2, 2]] * 2
    assert matches.query_inds.tolist() == [[1, 0, 1], [0, 0, 1]]
    assert matches.joined_inds.tolist() == [[1, 0, 1], [2, 2, 3]]  # of both layers' queries
    assert matches.gt_inds.tolist() == [[0, 1, 2], [0, 0, 2]]
    assert matches.rows.tolist() == [[0, 2, 3], [0, 1, 3]]
    for number, layer in enumerate(layers):
        alone = make_assigner().assign(layer, truth, [{}] * 3)
        for name in ("samples", "query_inds", "gt_inds", "rows", "order_inds", "host_labels"):
            assert torch.equal(getattr(alone, name)[0], getattr(matches, name)[number])


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_cost_that_is_not_finite_names_the_sample_and_the_cost(bad):
    pred = predictions(LINE, LINE * bad)
    with pytest.raises(FloatingPointError, match="OrderedPointsCost of sample 'token-7'"):
        assign(make_assigner(), pred, ground_truth(LINE), token="token-7")
    scores = torch.tensor([[0.0, bad, 0.0]])
    with pytest.raises(FloatingPointError, match="class scores of sample 'token-8'"):
        assign(make_assigner(), predictions(LINE, scores=scores), ground_truth(), token="token-8")


@pytest.mark.parametrize("shape", [(1, 2), (2,), (2, 2)])
def test_a_cost_of_another_shape_is_named(shape):
    assigner = make_assigner()
    assigner.match_costs.append(lambda pred, truth, meta: torch.zeros(shape))
    with pytest.raises(ValueError, match=r"must return the shape \(2, 1\), .* got \("):
        assign(assigner, predictions(LINE, LINE + 0.2), ground_truth(LINE))


def test_an_assigner_needs_a_cost():
    with pytest.raises(ValueError, match="at least one cost"):
        MapAssigner([])
