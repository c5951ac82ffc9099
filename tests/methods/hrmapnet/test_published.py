"""Parts of HRMapNet as its paper or release prints them; paper.json has further numbers."""

from mmdet3d.registry import MODELS
from mmengine.registry import init_default_scope
from paper_cases import head_of, load
from torch import nn

from gsmap.models.hrmapnet.keys import HRMAPNET


def published_model() -> nn.Module:
    init_default_scope("mmdet3d")
    cfg = load("configs/hrmapnet/hrmapnet_r50_24e.py").copy()
    model = cfg.model.to_dict()
    model["img_backbone"]["init_cfg"] = None
    return MODELS.build(model)


def test_sizes_and_parameters_as_released():
    model = published_model()
    prior = model.prior
    assert (prior.window.height, prior.window.width) == (200, 100)
    assert prior.scale == 1
    assert prior.bev.conv[0].weight.shape == (256, 259, 3, 3)
    assert prior.bev.layer.bev_embedding.weight.shape == (200 * 100, 256)
    assert prior.bev.layer.z_range == (-10.0, 10.0)
    assert prior.bev.layer.can_bus_mlp is None
    assert prior.queries.label_encoder.weight.shape == (256, 3)
    assert prior.bev.output_conv is None  # the features are replaced
    assert not prior.queries.zero_init
    assert prior.train_drop == 0
    assert prior.neutral_keys == ()
    assert model.map_head.instance_embedding.weight.shape == (350, 256)
    trained = sum(p.numel() for p in model.parameters() if p.requires_grad)
    assert trained == 46_960_658


def test_first_references_come_from_three_layers():
    head = head_of("configs/hrmapnet/hrmapnet_r50_24e.py")
    assert [part.out_features for part in head.reference.initial[::2]] == [256, 256, 2]


def test_every_key_has_a_name_in_the_release():
    keys = list(published_model().state_dict())
    upstream = [HRMAPNET.to_upstream(key) for key in keys]
    assert None not in upstream
    assert len(set(upstream)) == len(keys)
    assert [HRMAPNET.to_ours(key) for key in upstream] == keys
    assert HRMAPNET.is_marked(keys, upstream=False)
