import numpy as np
import pytest
import torch
from mmcv.ops.multi_scale_deform_attn import multi_scale_deformable_attn_pytorch

from gsmap.models.encoders.bev_query_encoder import BEVQueryEncoder, BEVSelfAttention
from gsmap.models.encoders.bevformer import SpatialCrossAttention
from gsmap.models.encoders.projection import PillarProjection
from gsmap.structures.grid import BEVGrid

KERNEL = {"type": "GeometryKernelAttention", "num_heads": 2, "kernel_size": (3, 3)}
DEFORMABLE = {
    "type": "SpatialCrossAttention",
    "num_heads": 2,
    "num_points": 4,
    "num_heights": 2,
}


def small_encoder(cross_attn=KERNEL, num_cams=2, **kwargs):
    return BEVQueryEncoder(
        cross_attn,
        BEVGrid((-4, 4), (-8, 8)),
        bev_pixel_m=2.0,
        embed_dims=16,
        layer_cfg={"num_heads": 2, "num_points": 2, "ffn_dims": 24},
        num_cams=num_cams,
        **kwargs,
    ).eval()


def meta(shift=0.0, **kwargs):
    forward = np.array([[10.0, 8, 0, shift], [0, 4, -10, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    backward = forward @ np.diag([-1.0, -1, 1, 1])
    return {
        "token": "abc",
        "lidar2img": np.stack([forward, backward]),
        "batch_input_shape": (8, 16),
        **kwargs,
    }


@pytest.mark.parametrize("cross_attn", [KERNEL, DEFORMABLE], ids=["kernel", "deformable"])
def test_a_batch_gives_what_its_samples_give_alone(cross_attn):
    torch.manual_seed(0)
    encoder = small_encoder(cross_attn)
    feats = torch.randn(2, 2, 16, 4, 8)
    metas = [meta(), meta(shift=20.0, can_bus=np.arange(18.0))]
    with torch.no_grad():
        both = encoder([feats], metas)["bev_feats"]
        alone = [encoder([feats[i : i + 1]], metas[i : i + 1])["bev_feats"] for i in range(2)]
    assert both.shape == (2, 16, 8, 4)
    torch.testing.assert_close(both, torch.cat(alone), atol=1e-5, rtol=1e-5)
    assert not torch.allclose(both[0], both[1])


def test_row_zero_is_the_smallest_y():
    torch.manual_seed(0)
    encoder = small_encoder(num_cams=2)
    feats = torch.zeros(1, 2, 16, 4, 8)
    with torch.no_grad():
        dark = encoder([feats], [meta()])["bev_feats"]
        feats[:, 1] = 5.0  # the camera that looks backward, to negative y
        lit = encoder([feats], [meta()])["bev_feats"]
    changed = (lit - dark).abs().amax((0, 1)) > 1e-4  # (8, 4)
    assert changed[0].all()
    assert not changed[4:].any()


def test_self_attention_equals_the_mean_over_two_equal_queue_entries():
    torch.manual_seed(0)
    attention = BEVSelfAttention(embed_dims=8, num_heads=2, num_points=3).eval()
    for parameter in attention.parameters():
        torch.nn.init.normal_(parameter, std=0.5)
    query, position, centres = torch.randn(1, 12, 8), torch.randn(1, 12, 8), torch.rand(1, 12, 2)
    pair = torch.cat([query, query + position], -1)
    value = attention.value_proj(query).view(1, 12, 2, 4)
    offsets = attention.sampling_offsets(pair).view(1, 12, 2, 2, 3, 2)  # heads, queue, points
    weights = attention.attention_weights(pair).view(1, 12, 2, 2, 3).softmax(-1)
    outs = []
    for entry in range(2):
        locations = centres[:, :, None, None] + offsets[:, :, :, entry] / torch.tensor([4, 3])
        outs.append(
            multi_scale_deformable_attn_pytorch(
                value,
                torch.tensor([[3, 4]]),
                locations[:, :, :, None],
                weights[:, :, :, entry, None],
            )
        )
    expected = attention.output_proj((outs[0] + outs[1]) / 2)
    bev = query.transpose(1, 2).unflatten(-1, (3, 4))
    torch.testing.assert_close(attention(pair, centres, bev), expected, atol=1e-5, rtol=1e-5)


def test_spatial_cross_attention_equals_its_definition():
    torch.manual_seed(0)
    module = SpatialCrossAttention(embed_dims=8, num_heads=2, num_points=4, num_heights=2).eval()
    for parameter in module.parameters():
        torch.nn.init.normal_(parameter, std=0.5)
    query, img_feats = torch.randn(2, 5, 8), torch.randn(2, 3, 8, 4, 6)
    projection = PillarProjection(torch.rand(2, 3, 5, 2, 2), torch.rand(2, 3, 5) < 0.6)
    offsets = module.sampling_offsets(query).view(2, 5, 2, 2, 2, 2)  # heads, repeats, heights, xy
    weights = module.attention_weights(query).view(2, 5, 2, 4).softmax(-1)
    total = torch.zeros(2, 5, 8)
    for view in range(3):
        value = module.value_proj(img_feats[:, view].flatten(2).transpose(1, 2)).view(2, 24, 2, 4)
        centres = projection.uv[:, view, :, None, None]
        locations = (centres + offsets / torch.tensor([6, 4])).flatten(3, 4)
        seen = multi_scale_deformable_attn_pytorch(
            value, torch.tensor([[4, 6]]), locations[:, :, :, None], weights[:, :, :, None]
        )
        total += seen * projection.visible[:, view, :, None]
    expected = module.output_proj(total / projection.visible.sum(1).clamp(min=1)[..., None])
    torch.testing.assert_close(module(query, img_feats, projection), expected, atol=1e-5, rtol=1e-5)


def test_bad_inputs_are_named():
    encoder = small_encoder()
    with pytest.raises(ValueError, match="built for 2 cameras, got 3"):
        encoder([torch.zeros(1, 3, 16, 4, 8)], [meta()])
    without = {key: value for key, value in meta().items() if key != "lidar2img"}
    with pytest.raises(ValueError, match="'abc' has no 'lidar2img'"):
        encoder([torch.zeros(1, 2, 16, 4, 8)], [without])
    with pytest.raises(ValueError, match="multiple of num_heights, got 5 and 2"):
        small_encoder({**DEFORMABLE, "num_points": 5})
