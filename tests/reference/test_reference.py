"""Our models against the reference, with the code of ``PYTHONPATH=tests python -m reference``."""

from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from reference.golden import Golden
from reference.registry import plan, run_checks
from reference.report import (
    Row,
    format_table,
    fraction_beyond,
    largest_difference,
    largest_relative,
    relative_norm,
)

REPO = Path(__file__).resolve().parents[2]
FILES = [
    "maptr_r50_state.json",
    "mapvr_r50_state.json",
    "ops_gka_*.npz",
    "mapvr_rasters_*.npz",
    "mapvr_dice_*.npz",
    "mapvr_headloss_closed_*.npz",
    "mapvr_headloss_many_*.npz",
    "maptr_r50_forward_reduced_*.npz",
    "maptr_r50_forward_full_*.npz",
    "maptr_gt_*.npz",
    "maptr_loss_empty_*.npz",
    "maptr_loss_closed_*.npz",
    "maptr_loss_many_*.npz",
    "maptr_loss_batch3_*.npz",
    "gemap_gda_*.npz",
    "gemap_geoloss_*.npz",
    "gemap_simple_r50_state.json",
    "gemap_simple_r50_forward_reduced_*.npz",
    "gemap_headloss_closed_*.npz",
    "gemap_headloss_many_*.npz",
    "maptrv2_r50_state.json",
    "maptrv2_r50_forward_reduced_*.npz",
    "maptrv2_r50_forward_full_*.npz",
    "maptrv2_loss_reduced_closed_*.npz",
    "maptrv2_loss_reduced_many_*.npz",
    "mgmapnet_state.json",
    "mgmapnet_patchmerge_*.npz",
    "mgmapnet_attention_*.npz",
    "mgmapnet_layer_*.npz",
    "mgmapnet_decoder_*.npz",
    "mgmapnet_losses_*.npz",
    "mgmapnet_forward_reduced_*.npz",
    "mapqr_state.json",
    "mapqr_encoder_*.npz",
    "mapqr_attention_*.npz",
    "mapqr_layer_*.npz",
    "mapqr_decoder_*.npz",
    "mapqr_losses_*.npz",
    "mapqr_forward_reduced_*.npz",
    "mgmap_state.json",
    "mgmap_masks_*.npz",
    "mgmap_neck_*.npz",
    "mgmap_decoder_*.npz",
    "mgmap_refine_*.npz",
    "mgmap_losses_*.npz",
    "mgmap_forward_reduced_*.npz",
    "streammapnet_state.json",
    "streammapnet_attention_*.npz",
    "streammapnet_fusion_*.npz",
    "streammapnet_stream_*.npz",
    "streammapnet_losses_*.npz",
    "streammapnet_forward_reduced_*.npz",
    *(f"pivotnet_{part}_*.npz" for part in ("pivots", "matching", "decoder", "head", "losses")),
    "pivotnet_projection_*.npz",
    "pivotnet_forward_reduced_*.npz",
    "pivotnet_state.json",
    "vectormapnet_state.json",
    *(f"vectormapnet_{part}_*.npz" for part in ("targets", "detector", "generator", "decoding")),
    "vectormapnet_losses_*.npz",
    "vectormapnet_forward_reduced_*.npz",
    *(f"bemapnet_{part}_*.npz" for part in ("bifpn", "bevdecoder", "insdecoder", "head")),
    *(f"bemapnet_{part}_*.npz" for part in ("bezier", "targets", "losses", "forward_reduced")),
    "bemapnet_state.json",
    *(f"hdmapnet_{part}_*.npz" for part in ("view", "decoders", "targets", "losses", "post")),
    "hdmapnet_forward_*.npz",
    "hdmapnet_state.json",
]


@pytest.fixture(scope="module")
def golden(golden_dir):
    return Golden(golden_dir / "models", REPO / "configs")


@pytest.mark.parametrize("files", FILES)
def test_ours_agrees_with_the_reference(golden, files):
    rows = list(run_checks(golden, files))
    assert all(row.passed for row in rows), "\n" + format_table(rows)


@contextmanager
def shifted(parameter, offset):
    """Make a parameter of a shared model wrong, for a while."""
    right = parameter.detach().clone()
    parameter.data += offset
    try:
        yield
    finally:
        parameter.data.copy_(right)


def missed(golden, files):
    """Return the quantities that do not agree."""
    return {row.quantity for row in run_checks(golden, files) if not row.passed}


def test_a_wrong_weight_is_noticed(golden):
    head = golden.model("maptr/maptr_r50_24e.py", "maptr_r50_state.json").map_head
    with shifted(head.reference.branches[2][-1].bias, 0.1):
        found = missed(golden, "maptr_r50_forward_reduced_*.npz")
    assert {"all_pts_preds", "all_cls_scores", "dec_pts (m)"} <= found


def test_a_wrong_depth_weight_is_noticed(golden):
    encoder = golden.model("maptrv2/maptrv2_r50_24e.py", "maptrv2_r50_state.json").bev_encoder
    with shifted(encoder.depth_net.depth_conv[-1].bias[0], 1.0):
        found = missed(golden, "maptrv2_r50_forward_reduced_*.npz")
    assert {"depth", "fraction of BEV cells that differ"} <= found
    assert "pv_seg" not in found  # it does not depend on depth


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
    assert not Row("f", "q", largest_difference([np.nan], [1.0]), 1.0).passed
    assert fraction_beyond([np.nan, 1.0], [1.0, 1.0], 0.1) == 0.5


def test_the_table_says_which_row_missed():
    table = format_table([Row("a.npz", "x", 1e-6, 1e-4), Row("b.npz", "y", 2.0, 0)])
    lines = table.splitlines()
    assert lines[2].split() == ["a.npz", "x", "1.00e-06", "1e-04", "ok"]
    assert lines[3].split() == ["b.npz", "y", "2.00e+00", "0e+00", "MISS"]
