"""Conversion of a config of the authors' code."""

import pytest
from methods.gemap.cases import FULL_SETTINGS, SHARED, SIMPLE
from upstream_configs import BASE, KERNEL, converted, maptr

from mapdata.upstream_configs.reader import read_assignments
from mapdata.upstream_configs.upstream import convert_upstream


def test_the_full_model_with_the_simple_objective_has_no_segmentation(tmp_path):
    """As in the releases for Argoverse 2, which switch all segmentations off."""
    settings = SHARED | FULL_SETTINGS | {"cameras": "num_cams=7,"}
    encoder = KERNEL.format(dropout=0.1).replace("pc_range=range_m, emb", "num_cams=7, emb")
    text = maptr(**settings, encoder=encoder, dataset="CustomAV2OfflineLocalMapDataset")
    off = "use_aux_seg=False, bev_seg=False, pv_seg=False,"
    text = text.replace("use_aux_seg=True, bev_seg=True, pv_seg=True,", off)
    text = text.replace("Attention', embed_dims=width, num_heads=8", "{}, num_ins=50, num_pts=20")
    text = text.replace("{}", "Attention', embed_dims=width, num_heads=8")
    cfg, unplaced = converted(text, tmp_path)
    assert unplaced == [BASE]
    assert cfg.model.map_head.type == "GeMapHead"
    assert "aux_heads" not in cfg.model.map_head
    assert cfg.model.bev_encoder.num_cams == 7


@pytest.mark.parametrize(
    ("theirs", "other", "named"),
    [
        ("type='GeometricLoss'", "type='ShapeLoss'", "loss_geo.type = 'ShapeLoss'"),
        ("num_ins=50", "num_ins=40", "loss_geo.num_ins = 40"),
        ("num_pts=points, pc", "num_pts=10, pc", "loss_geo.num_pts = 10"),
        ("pc_range=range_m, loss", "pc_range=[0, 0, 0, 9, 9, 9], loss", "loss_geo.pc_range = [0"),
        ("num_heads=8, drop", "num_heads=8, num_ins=40, drop", "attn_cfgs.0.num_ins = 40"),
    ],
)
def test_another_geometric_loss_is_named(theirs, other, named, tmp_path):
    assert SIMPLE.count(theirs) == 1
    _, unplaced = converted(SIMPLE.replace(theirs, other), tmp_path)
    assert len(unplaced) == 2
    assert any(named in line for line in unplaced)


def test_a_loss_that_is_off_has_no_effect(tmp_path):
    source = tmp_path / "theirs.py"
    source.write_text(SIMPLE.replace("use_geo_loss=True", "use_geo_loss=False"))
    conversion = convert_upstream(read_assignments(source))
    assert conversion.unplaced == [BASE]
    assert "model.map_head.loss_euclidean" not in conversion.settings
