"""MapTRv2 against the reference, with the code of ``tools/verify_reference.py``."""

from pathlib import Path

import pytest

from gsmap.verification.golden import Golden
from gsmap.verification.registry import run_checks
from gsmap.verification.report import format_table

REPO = Path(__file__).resolve().parents[2]
FILES = [
    "maptrv2_r50_state.json",
    "maptrv2_r50_forward_reduced_*.npz",
    "maptrv2_r50_forward_full_*.npz",
    "maptrv2_loss_reduced_closed_*.npz",
    "maptrv2_loss_reduced_many_*.npz",
]


@pytest.fixture(scope="module")
def golden(golden_dir):
    return Golden(golden_dir / "models", REPO / "configs")


@pytest.mark.parametrize("files", FILES)
def test_maptrv2_agrees_with_the_reference(golden, files):
    rows = list(run_checks(golden, files))
    assert all(row.passed for row in rows), "\n" + format_table(rows)


def test_a_wrong_depth_weight_is_noticed(golden):
    encoder = golden.model("maptrv2/maptrv2_r50_24e.py", "maptrv2_r50_state.json").bev_encoder
    bias = encoder.depth_net.depth_conv[-1].bias.data
    bias[0] += 1.0
    try:
        rows = list(run_checks(golden, "maptrv2_r50_forward_reduced_*.npz"))
    finally:
        bias[0] -= 1.0
    failed = {row.quantity for row in rows if not row.passed}
    assert "depth" in failed
    assert "fraction of BEV cells that differ" in failed
    assert "pv_seg" not in failed  # it does not depend on depth
