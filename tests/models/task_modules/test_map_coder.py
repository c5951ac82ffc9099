import pytest
import torch

from gsmap.models.task_modules.map_coder import MapCoder


def lines(*starts):
    return torch.stack([torch.tensor([[x, 0.0], [x, 10.0]]) for x in starts])


def test_the_best_pairs_of_query_and_class_come_first():
    scores = torch.tensor([[0.0, 2.0], [3.0, 1.0]])
    best = MapCoder(max_num=3).decode(scores, lines(0.0, 1.0))
    torch.testing.assert_close(best.scores, torch.tensor([3.0, 2.0, 1.0]).sigmoid())
    assert best.labels.tolist() == [0, 1, 1]
    assert best.query_inds.tolist() == [1, 0, 1]


def test_elements_that_leave_the_range_are_dropped():
    coder = MapCoder(max_num=10, post_center_range=[-20, -35, 20, 10])
    best = coder.decode(torch.tensor([[1.0], [2.0], [3.0]]), lines(0.0, 20.1, -20.0))
    assert best.query_inds.tolist() == [2, 0]  # the border itself belongs to the range


def test_low_scores_can_be_dropped():
    best = MapCoder(score_threshold=0.5).decode(torch.tensor([[-1.0], [1.0]]), lines(0.0, 1.0))
    assert best.query_inds.tolist() == [1]


def test_wrong_settings_are_refused():
    with pytest.raises(ValueError, match="max_num must be >= 1, got 0"):
        MapCoder(max_num=0)
    with pytest.raises(ValueError, match="post_center_range must hold 4 values, got 6"):
        MapCoder(post_center_range=[0] * 6)
