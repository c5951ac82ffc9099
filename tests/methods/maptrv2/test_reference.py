"""The comparison with the reference notices a wrong depth."""

from pathlib import Path

from reference.golden import Golden
from reference.mistakes import missed, shifted

REPO = Path(__file__).resolve().parents[3]


def test_a_wrong_depth_weight_is_noticed(golden_dir):
    golden = Golden(golden_dir / "models", REPO / "configs")
    encoder = golden.model("maptrv2/maptrv2_r50_24e.py", "maptrv2_r50_state.json").bev_encoder
    with shifted(encoder.depth_net.depth_conv[-1].bias[0], 1.0):
        found = missed(golden, "maptrv2_r50_forward_reduced_*.npz")
    assert {"depth", "fraction of BEV cells that differ"} <= found
    assert "pv_seg" not in found  # it does not depend on depth
