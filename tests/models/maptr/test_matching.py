import pytest
import torch
from mmengine.structures import InstanceData

from gsmap.models.maptr.matching import MapAssigner

LINE = torch.tensor([[0.1, 0.1], [0.2, 0.1], [0.3, 0.1]])


def make_assigner(*costs):
    return MapAssigner(costs or [{"type": "OrderedPointsCost", "weight": 5.0}])


def ground_truth(*lines):
    orders = [torch.stack([line, line.flip(0)]) for line in lines]
    shifts = torch.stack(orders) if orders else torch.zeros(0, 2, 3, 2)
    return InstanceData(labels=torch.zeros(len(lines), dtype=torch.long), pts_shifts=shifts)


def predictions(*lines, scores=None):
    scores = torch.zeros(len(lines), 3) if scores is None else scores
    return InstanceData(scores=scores, pts=torch.stack(lines))


def test_each_ground_truth_gets_its_closest_prediction_in_its_order():
    pred = predictions(LINE + 0.6, LINE.flip(0) + 0.3, LINE + 0.01)
    match = make_assigner().assign(pred, ground_truth(LINE, LINE + 0.3))
    assert match.query_inds.tolist() == [1, 2]
    assert match.gt_inds.tolist() == [1, 0]
    assert match.order_inds.tolist() == [1, 0]


def test_the_sum_of_costs_decides_not_each_ground_truth_alone():
    # both ground truths are closest to prediction 0; giving it to the second costs less in all
    pred = predictions(LINE, LINE + 0.2)
    match = make_assigner().assign(pred, ground_truth(LINE + 0.02, LINE - 0.01))
    assert match.gt_inds.tolist() == [1, 0]


def test_repeated_ground_truth_gets_its_closest_predictions():
    pred = predictions(LINE + 0.01, LINE.flip(0) + 0.31, LINE + 0.6, LINE, LINE + 0.3)
    match = make_assigner().assign(pred, ground_truth(LINE, LINE + 0.3), repeats=2)
    assert match.query_inds.tolist() == [0, 1, 3, 4]
    assert match.gt_inds.tolist() == [0, 1, 0, 1]
    assert match.order_inds.tolist() == [0, 1, 0, 0]


def test_the_class_cost_breaks_ties():
    scores = torch.tensor([[-5.0, 0.0, 0.0], [5.0, 0.0, 0.0]])
    costs = [{"type": "mmdet.FocalLossCost", "weight": 2.0}, {"type": "OrderedPointsCost"}]
    pred = predictions(LINE, LINE, scores=scores)
    match = make_assigner(*costs).assign(pred, ground_truth(LINE))
    assert match.query_inds.tolist() == [1]


def test_no_ground_truth_and_more_ground_truth_than_queries():
    assert len(make_assigner().assign(predictions(LINE), ground_truth()).query_inds) == 0
    match = make_assigner().assign(predictions(LINE), ground_truth(LINE + 0.5, LINE))
    assert match.gt_inds.tolist() == [1]


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_cost_that_is_not_finite_names_the_sample_and_the_cost(bad):
    pred = predictions(LINE, LINE * bad)
    with pytest.raises(FloatingPointError, match="OrderedPointsCost of sample 'token-7'"):
        make_assigner().assign(pred, ground_truth(LINE), {"token": "token-7"})
    scores = torch.tensor([[0.0, bad, 0.0]])
    with pytest.raises(FloatingPointError, match="class scores of sample 'token-8'"):
        make_assigner().assign(
            predictions(LINE, scores=scores), ground_truth(), {"token": "token-8"}
        )


def test_an_assigner_needs_a_cost():
    with pytest.raises(ValueError, match="at least one cost"):
        MapAssigner([])
