import pytest
import torch

from gsmap.models.base.coder import MapCoder
from gsmap.structures.grid import BEVGrid

GRID = BEVGrid((-15, 15), (-30, 30))


def lines(*starts):
    return torch.stack([torch.tensor([[x, 0.0], [x, 10.0]]) for x in starts])


def test_the_best_pairs_of_query_and_class_come_first():
    scores = torch.tensor([[0.0, 2.0], [3.0, 1.0]])
    best = MapCoder(GRID, max_num=3).decode(scores, lines(0.0, 1.0))
    torch.testing.assert_close(best.scores, torch.tensor([3.0, 2.0, 1.0]).sigmoid())
    assert best.labels.tolist() == [0, 1, 1]
    assert best.query_inds.tolist() == [1, 0, 1]


def test_elements_that_leave_the_range_are_dropped():
    coder = MapCoder(BEVGrid((-15, 15), (-30, 5)), max_num=10, margin_m=5.0)
    best = coder.decode(torch.tensor([[1.0], [2.0], [3.0]]), lines(0.0, 20.1, -20.0))
    assert best.query_inds.tolist() == [2, 0]  # the border itself belongs to the range


def test_without_a_margin_nothing_is_dropped():
    best = MapCoder(GRID, margin_m=None).decode(torch.ones(2, 1), lines(0.0, 99.0))
    assert sorted(best.query_inds.tolist()) == [0, 1]


def test_low_scores_can_be_dropped():
    best = MapCoder(GRID, score_threshold=0.5).decode(
        torch.tensor([[-1.0], [1.0]]), lines(0.0, 1.0)
    )
    assert best.query_inds.tolist() == [1]


def test_points_of_lines_are_unfolded_with_all_that_belongs_to_them():
    folded = torch.tensor([[0.0, 0], [0, 2], [0, 1], [0, 3]])
    fields = {"pts": folded.repeat(2, 1, 1), "scales": torch.arange(16.0).view(2, 4, 2)}
    coder = MapCoder(GRID, unfold_classes=[2])
    found = coder.unfold_lines(fields, torch.tensor([2, 1]))
    assert found["pts"][:, :, 1].tolist() == [[0, 1, 2, 3], [0, 2, 1, 3]]
    assert found["scales"][0].tolist() == [[0, 1], [4, 5], [2, 3], [6, 7]]
    torch.testing.assert_close(found["scales"][1], fields["scales"][1])
    assert MapCoder(GRID).unfold_lines(fields, torch.tensor([2, 2])) is fields


def test_wrong_settings_are_refused():
    with pytest.raises(ValueError, match="max_num must be >= 1, got 0"):
        MapCoder(GRID, max_num=0)
    with pytest.raises(ValueError, match="margin_m must be > 0, got -1"):
        MapCoder(GRID, margin_m=-1)
