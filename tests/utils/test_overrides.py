"""Wrong values of ``--cfg-options`` end in one line that names them."""

from types import SimpleNamespace

import pytest

from gsmap.datasets.vectorized_map_dataset import VectorizedMapDataset
from gsmap.utils.overrides import check_kinds, declare_overrides, describe_override

SETTINGS = {
    "clip_grad": {"max_norm": 35},
    "classes": ["a", "b"],
    "resume": False,
    "num_workers": 2,
    "hooks": [{"type": "A"}],
    "load_from": None,
}


@pytest.fixture(autouse=True)
def no_overrides():
    """Forget the overrides of a test."""
    yield
    declare_overrides({})


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("clip_grad.max_norm", "abc", "must be a number, got 'abc': it is 35 in a.py"),
        ("clip_grad.max_norm", {"a": 1}, "must be a number, got"),
        ("clip_grad", 5, r"must be dict\(...\) or a list of it, got 5"),
        ("hooks", "abc", r"must be dict\(...\) or a list of it, got 'abc'"),
        ("hooks.0", "abc", r"hooks.0 must be dict\(...\) or a list of it, got 'abc'"),
        ("hooks", ["abc"], r"must be dict\(...\) or a list of it"),
        ("classes", "a", r"classes must be a list, such as \[a\], got 'a'"),
        ("resume", "abc", "resume must be True or False, got 'abc'"),
    ],
)
def test_a_value_of_another_kind_is_refused(name, value, text):
    with pytest.raises(ValueError, match=text):
        check_kinds(SETTINGS, overrides={name: value}, source="a.py")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("clip_grad.max_norm", 0.5),
        ("clip_grad.max_norm", None),
        ("clip_grad", None),
        ("clip_grad.norm_type", "inf"),
        ("num_workers", "cores"),
        ("num_workers", [1, 2]),
        ("hooks", []),
        ("hooks", {"type": "A"}),
        ("classes", ["c"]),
        ("classes.5", "c"),
        ("resume", 1),
        ("load_from", "a.pth"),
        ("load_from", 5),
    ],
)
def test_a_value_of_its_kind_is_taken(name, value):
    check_kinds(SETTINGS, overrides={name: value}, source="a.py")


class Layers:
    """A part that fails when it is used."""

    def __init__(self, count: int, scale: object = 1.0) -> None:
        self._count = count
        self.scale = scale

    def last(self) -> int:
        return list(range(self._count))[-1]

    def use(self, **settings: object) -> float:
        return float("x")


def error_of(call) -> Exception:
    """Return the error of a call."""
    try:
        call()
    except Exception as error:
        return error
    raise AssertionError("nothing failed")


def test_the_override_that_failing_code_uses_is_named(monkeypatch):
    declare_overrides({"model.lr": 0.1, "model.layers.0.count": -2})
    error = error_of(Layers(-2).last)
    assert describe_override(error) == (
        "IndexError: list index out of range, in code that uses --cfg-options "
        "model.layers.0.count=-2: check this value (GSMAP_TRACEBACK=1 shows where)."
    )
    monkeypatch.setenv("GSMAP_TRACEBACK", "1")
    assert describe_override(error) is None


def test_overrides_are_found_in_dictionaries_and_in_causes():
    declare_overrides({"optimizer.betas": [1, 2]})
    failed = error_of(lambda: Layers(1).use(betas=(1, 2)))
    assert "optimizer.betas=[1, 2]" in describe_override(failed)

    def wrap() -> None:
        raise TypeError("in a hook") from failed

    assert "optimizer.betas=[1, 2]" in describe_override(error_of(wrap))


def test_an_error_beside_the_overrides_stays_a_bug():
    error = error_of(lambda: Layers(1, scale=3).use())
    assert describe_override(error) is None
    for name, value in (("a.count", 2), ("a.scale", 3.5), ("b", 1), ("data_root", 1)):
        declare_overrides({name: value})
        assert describe_override(error) is None


def test_a_data_set_names_the_override_since_workers_send_only_texts():
    layers = Layers(-2)
    dataset = SimpleNamespace(pipeline=lambda info: layers.last(), get_data_info=lambda index: {})
    declare_overrides({"dataset.pipeline.0.count": -2})
    with pytest.raises(ValueError, match=r"uses --cfg-options dataset\.pipeline\.0\.count=-2"):
        VectorizedMapDataset.prepare_data(dataset, 0)
    declare_overrides({})
    with pytest.raises(IndexError):
        VectorizedMapDataset.prepare_data(dataset, 0)
