"""Conversion of a config of the authors' code."""

from methods.mapvr.cases import upstream_config
from upstream_configs import converted


def test_deformable_attention_keeps_its_dropout(tmp_path):
    cfg, _ = converted(upstream_config(), tmp_path)
    assert cfg.model.map_head.decoder.layer.dropout == 0
    assert cfg.model.map_head.decoder.layer.cross_attn == {"dropout": 0.1}
    assert cfg.model.bev_encoder.layer_cfg.dropout == 0
    assert cfg.train_dataloader.batch_size == 8
