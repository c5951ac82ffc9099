import pytest

from gsmap.apis.map_inferencer import select_samples


def test_samples_are_chosen_by_token_and_spread_evenly():
    tokens = [f"t{i}" for i in range(10)]
    assert select_samples(tokens) == list(range(10))
    assert select_samples(tokens, ["t3", "t1"]) == [3, 1]
    assert select_samples(tokens, ["t3", "t1", "t3"]) == [3, 1]
    assert select_samples(tokens, max_num=4) == [0, 3, 6, 9]
    assert select_samples(tokens, max_num=1) == [0]
    with pytest.raises(ValueError, match="No sample has the token 'x'; there are 10"):
        select_samples(tokens, ["t1", "x"])
    with pytest.raises(ValueError, match="max_num must be >= 1"):
        select_samples(tokens, max_num=0)
