"""Published configs train as their releases do: their settings, against a table of these."""

from dataclasses import asdict, replace

import pytest
from mmdet3d.registry import MODELS
from mmengine.optim import build_optim_wrapper
from released_settings import REPO, released, settings_of
from test_configs import load
from unset_weights import unset_weights

from gsmap.models.encoders.gkt import GeometryKernelAttention
from gsmap.structures.grid import BEVGrid


@pytest.mark.parametrize("name", released(), ids=lambda name: name.rpartition("/")[2])
def test_settings_are_those_of_the_release(name):
    cfg = load(REPO / name)
    with unset_weights():
        model = MODELS.build(cfg.model).train()
    groups = build_optim_wrapper(model, cfg.optim_wrapper).optimizer.param_groups
    found, wanted = asdict(settings_of(cfg, model, groups)), asdict(released()[name])
    assert found.keys() == wanted.keys()
    for key, value in wanted.items():
        assert found[key] == pytest.approx(value), key


def test_the_table_notices_a_change():
    """Another rate of the backbone."""
    name = "configs/maptr/maptr_r50_24e.py"
    cfg = load(REPO / name)
    cfg.optim_wrapper.paramwise_cfg.custom_keys.pop("img_backbone")
    with unset_weights():
        model = MODELS.build(cfg.model).train()
    groups = build_optim_wrapper(model, cfg.optim_wrapper).optimizer.param_groups
    found = settings_of(cfg, model, groups)
    assert found.rates["img_backbone"] == pytest.approx(6e-4)
    assert replace(found, rates=released()[name].rates) == released()[name]


def test_kernels_and_positions_start_as_released():
    """Xavier's law and N(0, 1) in MapTR; MiniCity as ever."""
    published = load(REPO / "configs/maptr/maptr_r50_24e.py").model.bev_encoder
    small = load(REPO / "configs/maptr/maptr_r18_minicity.py").model.bev_encoder
    grid = load(REPO / "configs/maptr/maptr_r50_24e.py").grid
    for encoder, std in ((published, 1.0), (small, 12**-0.5)):
        built = MODELS.build({**encoder, "grid": BEVGrid(**grid)})
        built.init_weights()
        rows = built.positional_encoding.row_embed.weight
        assert float(rows.std()) == pytest.approx(std, rel=0.05)
        assert float(rows.mean()) == pytest.approx(0.0 if std == 1 else 0.5, abs=0.05)
        weights = built.layers[0].cross_attn.attention_weights.weight
        bound = (6 / sum(weights.shape)) ** 0.5 if std == 1 else 0.0
        assert float(weights.abs().max()) == pytest.approx(bound, rel=0.01)
        assert not built.layers[0].cross_attn.attention_weights.bias.any()
    assert GeometryKernelAttention(16, 4).attention_weights.weight.any()
