import pytest

from gsmap.apis.map_inferencer import find_sample_file, select_samples


def test_samples_are_chosen_by_token_and_spread_evenly():
    tokens = [f"t{i}" for i in range(10)]
    assert select_samples(tokens) == list(range(10))
    assert select_samples(tokens, ["t3", "t1"]) == [3, 1]
    assert select_samples(tokens, max_num=4) == [0, 3, 6, 9]
    assert select_samples(tokens, max_num=1) == [0]
    with pytest.raises(ValueError, match="No sample has the token 'x'; there are 10"):
        select_samples(tokens, ["t1", "x"])
    with pytest.raises(ValueError, match="max_num must be >= 1"):
        select_samples(tokens, max_num=0)


def test_sample_file_is_found_or_the_trouble_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="There is no sample file"):
        find_sample_file(tmp_path / "gone")
    with pytest.raises(FileNotFoundError, match=r"holds no \*.arrow or \*.pkl"):
        find_sample_file(tmp_path)
    (tmp_path / "a.arrow").touch()
    assert find_sample_file(tmp_path).name == "a.arrow"
    (tmp_path / "b.pkl").touch()
    with pytest.raises(ValueError, match=r"several sample files \(a.arrow, b.pkl\)"):
        find_sample_file(tmp_path)
    (tmp_path / "c.json").touch()
    with pytest.raises(ValueError, match=r"c.json must be an annotation file"):
        find_sample_file(tmp_path / "c.json")
