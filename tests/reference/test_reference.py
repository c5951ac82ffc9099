"""Our models against the reference, with the code of ``PYTHONPATH=tests python -m reference``."""

from pathlib import Path

import numpy as np
import pytest

from reference.golden import Golden
from reference.mistakes import missed, shifted
from reference.registry import CHECKS, load_checks, plan, run_checks
from reference.report import (
    Row,
    format_table,
    fraction_beyond,
    largest_difference,
    largest_relative,
    relative_norm,
)

REPO = Path(__file__).resolve().parents[2]
load_checks()
FILES = [pattern.format(variant="*") for pattern, _ in CHECKS]


@pytest.fixture(scope="module")
def golden(golden_dir):
    return Golden(golden_dir / "models", REPO / "configs")


@pytest.mark.parametrize("files", FILES)
def test_ours_agrees_with_the_reference(golden, files):
    rows = list(run_checks(golden, files))
    assert all(row.passed for row in rows), "\n" + format_table(rows)


def test_every_file_of_outputs_has_a_check(golden):
    """States without one are the weights of a part, which a check of outputs reads."""
    unchecked = [name for name in plan(golden)[1] if not name.endswith("_state.json")]
    assert unchecked == []


def test_a_wrong_weight_is_noticed(golden):
    head = golden.model("maptr/maptr_r50_24e.py", "maptr_r50_state.json").map_head
    with shifted(head.reference.branches[2][-1].bias, 0.1):
        found = missed(golden, "maptr_r50_forward_reduced_*.npz")
    assert {"all_pts_preds", "all_cls_scores", "dec_pts (m)"} <= found


def test_a_folder_without_the_variant_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no reference file of variant 'Z'"):
        list(run_checks(Golden(tmp_path, REPO / "configs", variant="Z")))


def test_files_without_a_check_are_listed(tmp_path):
    for name in ("riddle_B.npz", "riddle_A.npz", "riddle_state.json", "maptr_loss_many_B.npz"):
        (tmp_path / name).touch()
    chosen, unchecked = plan(Golden(tmp_path, REPO / "configs", variant="B"))
    assert [name for name, _ in chosen] == ["maptr_loss_many_B.npz"]
    assert unchecked == ["riddle_B.npz", "riddle_state.json"]


def test_missing_recipes_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"weights_recipe\.py: give the folder"):
        _ = Golden(tmp_path, REPO / "configs").weights


def test_measures_of_deviation_by_hand():
    ours, reference = [1.0, 2.0, 3.5], [1.0, 2.5, 3.0]
    assert largest_difference(ours, reference) == 0.5
    assert largest_relative(ours, reference) == pytest.approx(0.2)
    assert relative_norm([3.0, 4.0], [0.0, 4.0]) == pytest.approx(0.75)
    assert fraction_beyond(ours, reference, 0.4) == pytest.approx(2 / 3)


def test_another_shape_or_a_nan_never_passes():
    for measure in (largest_difference, largest_relative, relative_norm):
        assert measure([1.0], [1.0, 2.0]) == np.inf
        worst = max(0.0, measure([np.nan], [1.0]))  # of several deviations
        assert not Row("f", "q", worst, 1.0).passed
    assert fraction_beyond([np.nan, 1.0], [1.0, 1.0], 0.1) == 0.5


def test_the_table_says_which_row_missed():
    table = format_table([Row("a.npz", "x", 1e-6, 1e-4), Row("b.npz", "y", 2.0, 0)])
    lines = table.splitlines()
    assert lines[2].split() == ["a.npz", "x", "1.00e-06", "1e-04", "ok"]
    assert lines[3].split() == ["b.npz", "y", "2.00e+00", "0e+00", "MISS"]
