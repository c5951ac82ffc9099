"""What checkpoints and results say of a calibration: read, or refused."""

import pytest

from gsmap.utils.model_facts import calibration_of, law_of


def test_a_calibration_is_read_and_its_law_is_the_normal_one_by_default():
    said = {"calibration": {"law": "laplace", "sigmas": 2.0, "more": object()}}
    assert calibration_of(said) == {"law": "laplace", "sigmas": 2.0}
    assert law_of(said) == "laplace"
    assert calibration_of({}) == {}
    assert law_of({}) == "normal"


@pytest.mark.parametrize(
    "said",
    [
        5,
        "laplace",
        {},
        {"law": "cauchy", "sigmas": 1.0},
        {"law": ["normal"], "sigmas": 1.0},
        {"law": "normal", "sigmas": float("nan")},
        {"law": "normal", "sigmas": "1"},
        {"law": "normal", "sigmas": True},
    ],
)
def test_what_is_no_calibration_is_refused(said):
    with pytest.raises(ValueError, match=r"calibration must name a law of .*'laplace'.* got "):
        calibration_of({"calibration": said})
