"""Rules of writing: values by hand, and the settings of HRMapNet."""

import numpy as np
import pytest

from gsmap.prior.rules import (
    RULES,
    HitMissCounts,
    KeepMaximum,
    LastSeen,
    rule_from_settings,
    rule_settings,
)


def states_after(rule, values):
    """States and value of one cell of one class after predictions."""
    states = np.full((rule.num_states, 1, 1), rule.empty, np.uint8)
    for value in values:
        states = rule.update(states, np.array([[value]], np.float32))
        assert states.dtype == np.uint8
    return states.ravel().tolist(), rule.read(states).item()


@pytest.mark.parametrize(
    ("values", "state", "value"),
    [
        ([], 0, 0.0),
        ([0.5], 127, 127 / 255),
        ([0.5, 0.2, 0.0], 127, 127 / 255),
        ([0.5, 1.0], 255, 1.0),
    ],
)
def test_the_largest_prediction_stays(values, state, value):
    assert states_after(KeepMaximum(), values) == ([state], pytest.approx(value))


@pytest.mark.parametrize(
    ("values", "state", "value"),
    [
        ([], 100, 0.0),
        ([0.0], 99, 0.0),
        ([0.0, 0.0], 99, 0.0),  # a miss starts from 100 again
        ([1.0], 130, 1.0),
        ([1.0, 1.0], 130, 1.0),  # hits do not add up
        ([1.0, 0.5], 130, 1.0),
        ([0.5], 115, 0.5),
        ([0.5, 0.0], 114, 14 / 30),
        ([0.01], 100, 0.0),  # a hit that rounds to nothing, but no miss
        ([1.0] + 29 * [0.0], 101, 1 / 30),
        ([1.0] + 30 * [0.0], 100, 0.0),
    ],
)
def test_a_prediction_lasts_for_thirty_misses(values, state, value):
    assert states_after(LastSeen(), values) == ([state], pytest.approx(value))


def test_the_published_settings_are_the_defaults():
    expected = {"name": "last_seen", "gain": 30.0, "lowest": 2, "highest": 240}
    assert rule_settings(LastSeen()) == expected
    assert LastSeen.empty == 100
    assert rule_settings(KeepMaximum()) == {"name": "keep_maximum"}
    assert KeepMaximum.empty == 0


def test_counts_of_hits_and_misses():
    """Decay 0.5, a view is 127.5: hits 128, 192, 96 and misses 0, 0, 128 after hit, hit, miss."""
    rule = HitMissCounts(decay=0.5, prior_count=0.25)
    states, value = states_after(rule, [1.0, 1.0, 0.0])
    assert states == [96, 128]
    assert value == pytest.approx(96 / (96 + 128 + 0.25 * 127.5))
    assert states_after(rule, [])[1] == 0
    assert states_after(rule, [1.0])[1] == pytest.approx(0.8, abs=2e-3)  # rounded to a 255th
    assert states_after(rule, [0.5])[0] == [64, 64]


@pytest.mark.parametrize("decay", [0.5, 0.95, 0.98])
def test_counts_stay_in_range_and_forget(decay):
    rule = HitMissCounts(decay=decay)
    views = round(12 / (1 - decay))
    states, value = states_after(rule, views * [1.0])
    # a count rests once a step is less than half of a 255th
    assert 255 - 0.5 / (1 - decay) - 1 <= states[0] <= 255
    assert states[1] == 0
    assert value > 0.85
    states, value = states_after(rule, views * [1.0] + views * [0.0])
    assert states[0] == value == 0


@pytest.mark.parametrize("name", sorted(RULES))
def test_any_state_of_a_file_reads_as_a_value(name):
    rule = RULES[name]()
    states = np.random.default_rng(0).integers(0, 256, (rule.num_states, 2, 999), np.uint8)
    values = rule.read(states)
    assert values.dtype == np.float32
    assert 0 <= values.min() <= values.max() <= 1


@pytest.mark.parametrize("rule", [KeepMaximum(), LastSeen(gain=20.0), HitMissCounts(decay=0.9)])
def test_settings_make_an_equal_rule(rule):
    assert rule_from_settings(rule_settings(rule)) == rule


@pytest.mark.parametrize(
    "settings",
    [
        None,
        [],
        {"name": "other"},
        {"name": ["last_seen"]},
        {"name": "hit_miss_counts"},
        {"name": "keep_maximum", "gain": 3},
        {"name": "last_seen", "gain": "30", "lowest": 2, "highest": 240},
        {"name": "last_seen", "gain": float("nan"), "lowest": 2, "highest": 240},
        {"name": "last_seen", "gain": 30.0, "lowest": 2, "highest": 1e9},
        {"name": "hit_miss_counts", "decay": 1.0, "prior_count": 1},
        {"name": "hit_miss_counts", "decay": 0.9, "prior_count": 0},
        {"name": "hit_miss_counts", "decay": True, "prior_count": 1},
    ],
)
def test_foreign_settings_are_refused(settings):
    with pytest.raises(ValueError, match="must"):
        rule_from_settings(settings)
