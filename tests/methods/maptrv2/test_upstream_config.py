"""Conversion of a config of the authors' code."""

import pytest
from methods.maptrv2.cases import upstream_config
from upstream_configs import BASE, converted


def test_masks_have_a_channel_for_each_class_of_the_file(tmp_path):
    four = "'boundary', 'centerline']"
    cfg, _ = converted(upstream_config().replace("'boundary']", four), tmp_path)
    steps = {step.type: step for step in cfg.train_dataloader.dataset.pipeline}
    assert len(cfg.train_dataloader.dataset.classes) == 4
    assert steps["MakeBEVMask"].num_classes == steps["MakePVMask"].num_classes == 4


def test_segmentation_and_depth_are_as_in_the_file(tmp_path):
    """The config of this project has all three, and their steps."""
    text = upstream_config()
    off = text.replace("use_aux_seg=True", "use_aux_seg=False").replace("'gt_depth'", "")
    cfg, unplaced = converted(off, tmp_path)
    assert unplaced == [BASE]
    assert cfg.model.map_head.aux_heads == []
    steps = {step.type for step in cfg.train_dataloader.dataset.pipeline}
    assert not steps & {"MakeBEVMask", "MakePVMask", "MakeDepthMap"}
    cfg, _ = converted(text.replace("bev_seg=True", "bev_seg=False"), tmp_path)
    assert [head.type for head in cfg.model.map_head.aux_heads] == [
        "PVMaskHead",
        "DepthSupervision",
    ]
    thick = text.replace("feat_down_sample=32)", "feat_down_sample=16, pv_thickness=3)", 1)
    cfg, unplaced = converted(thick, tmp_path)
    assert unplaced == [BASE]
    steps = {step.type: step for step in cfg.train_dataloader.dataset.pipeline}
    assert (steps["MakePVMask"].stride, steps["MakePVMask"].thickness_px) == (16, 3)


def test_cameras_and_masks_of_argoverse2_without_depth(tmp_path):
    """As in a config of a release: the encoder has a weight of the depths, but there are none."""
    text = upstream_config().replace("CustomNuScenesOff", "CustomAV2Off").replace("'gt_depth'", "")
    text = text.replace("use_can_bus=True,", "use_can_bus=True, num_cams=7,")
    text = text.replace("pipeline=train_pipeline", "pipeline=train_pipeline, aux_seg=masks")
    cfg, unplaced = converted(text, tmp_path)
    assert unplaced == [BASE]
    assert [head.type for head in cfg.model.map_head.aux_heads] == ["BEVMaskHead", "PVMaskHead"]
    other = "aux_seg={**masks, 'pv_seg': False}"
    _, unplaced = converted(text.replace("aux_seg=masks, **", f"{other}, **"), tmp_path)
    assert "data.train.aux_seg.pv_seg = False" in unplaced


def test_repeats_of_one_to_many_matching_must_be_given(tmp_path):
    with pytest.raises(ValueError, match="k_one2many is missing"):
        converted(upstream_config().replace("k_one2many=6,", ""), tmp_path)
