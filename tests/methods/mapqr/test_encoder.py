"""MapQR's encoder: pillars whose heights move, and a kernel that is sampled bilinearly."""

import numpy as np
import pytest
import torch
from mmcv.ops.multi_scale_deform_attn import multi_scale_deformable_attn_pytorch

from gsmap.models.encoders.projection import PillarProjection
from gsmap.models.mapqr.encoder import HeightKernelAttention, HeightQueryEncoder, MovingPillars
from gsmap.structures.grid import BEVGrid

HEADS = 2


def pillars(start, offset_x=0.0):
    """One cell at (1, 2), seen by a camera that looks along y: u = 10 x / y, v = 10 z / y."""
    feet = torch.tensor([[1.0, 2.0, 0.0, 1.0]])
    matrix = torch.tensor([[10.0, 0, 0, offset_x], [0, 0, 10, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    return MovingPillars(feet, torch.tensor(start), (-1.0, 3.0), matrix[None, None], (20, 10))


def test_heights_move_by_metres_and_accumulate():
    own = pillars([0.0, 1.0])  # -1 m and 3 m
    uv, visible = own.move(torch.tensor([[[1.2, -2.0]]]), accumulate=True)  # 0.2 m and 1 m
    assert own.heights.flatten().tolist() == pytest.approx([0.3, 0.5])
    assert uv[0, 0, 0].tolist() == [pytest.approx([0.5, 0.05]), pytest.approx([0.5, 0.25])]
    assert visible.all()
    own.move(torch.tensor([[[0.4, 0.0]]]), accumulate=True)
    assert own.heights.flatten().tolist() == pytest.approx([0.4, 0.5])
    own.move(torch.tensor([[[0.4, 0.0]]]), accumulate=False)
    assert own.heights.flatten().tolist() == pytest.approx([0.1, 1.0])


def test_a_cell_is_seen_if_any_point_of_its_pillar_is():
    assert pillars([0.0, 1.0]).move(torch.zeros(1, 1, 2), True).visible.all()  # -1 m is above
    assert not pillars([0.0, 0.1]).move(torch.zeros(1, 1, 2), True).visible.any()
    assert not pillars([0.5, 1.0], offset_x=-10.0).move(torch.zeros(1, 1, 2), True).visible.any()


def test_attention_equals_its_definition():
    """Each head's 2 x 4 kernel at its height, bilinear; all points of a seen cell are used."""
    torch.manual_seed(0)
    module = HeightKernelAttention(embed_dims=8, num_heads=HEADS)
    torch.nn.init.normal_(module.attention_weights.weight)
    query, feats = torch.randn(2, 6, 8), torch.randn(2, 3, 8, 4, 7)
    seen = PillarProjection(torch.rand(2, 3, 6, HEADS, 2) * 1.4 - 0.2, torch.rand(2, 3, 6) < 0.5)
    seen.visible[:, :, 0] = False  # a cell that no camera sees
    weights = module.attention_weights(query).view(2, 6, HEADS, 1, 8).softmax(-1)
    total = torch.zeros(2, 6, 8)
    for view in range(3):
        value = module.value_proj(feats[:, view].flatten(2).transpose(1, 2)).unflatten(
            2, (HEADS, 4)
        )
        kernel = [(dx / 7, dy / 4) for dx in (-2, -1, 0, 1) for dy in (-1, 0)]
        places = seen.uv[:, view, :, :, None] + torch.tensor(kernel)
        shapes = torch.tensor([[4, 7]])
        part = multi_scale_deformable_attn_pytorch(value, shapes, places[:, :, :, None], weights)
        total += part * seen.visible[:, view, :, None]
    expected = module.output_proj(total / seen.visible.sum(1).clamp(min=1)[..., None])

    class Given:
        def move(self, offsets_m, accumulate):
            assert not offsets_m.any()  # pillars start where they are
            return seen

    torch.testing.assert_close(module(query, feats, Given()), expected)


def small_encoder(**cross_attn):
    torch.manual_seed(0)
    encoder = HeightQueryEncoder(
        {"num_heads": 2, **cross_attn},
        grid=BEVGrid((-4, 4), (-8, 8)),
        bev_pixel_m=2.0,
        embed_dims=16,
        num_layers=2,
        layer_cfg={"num_heads": 2, "num_points": 2, "ffn_dims": 24},
        num_cams=1,
    )
    encoder.init_weights()
    return encoder.eval()


def meta(shift=0.0):
    camera = np.array([[10.0, 8, 0, shift], [0, 4, -10, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    return {"token": "a", "lidar2img": camera[None], "batch_input_shape": (8, 16)}


def restless(encoder):
    for layer in encoder.layers:
        torch.nn.init.normal_(layer.cross_attn.height_offsets.weight)
    return encoder


def test_the_first_heights_are_even_and_reach_both_ends():
    start = small_encoder(num_heads=4).project(torch.eye(4)[None, None], (8, 16))
    assert start.heights.tolist() == pytest.approx([0, 1 / 3, 2 / 3, 1])
    assert (start.low_m, start.extent_m) == (-2.0, 4.0)


def test_a_batch_gives_what_its_samples_give_alone_unless_as_released():
    encoder, feats = restless(small_encoder()), torch.randn(2, 1, 16, 4, 8)
    metas = [meta(), meta(20.0)]
    with torch.no_grad():
        both = encoder([feats], metas)["bev_feats"]
        alone = [encoder([feats[i : i + 1]], metas[i : i + 1])["bev_feats"] for i in range(2)]
        torch.testing.assert_close(both, torch.cat(alone), atol=1e-5, rtol=1e-5)
        for layer in encoder.layers:
            layer.cross_attn.released_cells = True
        released = encoder([feats], metas)["bev_feats"]
        torch.testing.assert_close(released[0], both[0])
        assert not torch.allclose(released[1], both[1])


def test_heights_of_the_layer_before_count_only_where_they_accumulate():
    feats = torch.randn(1, 1, 16, 4, 8)
    outputs = [
        restless(small_encoder(accumulate_heights=switch))([feats], [meta()])["bev_feats"]
        for switch in (True, False)
    ]
    assert not torch.allclose(*outputs)


def test_every_parameter_but_the_idle_levels_learns():
    encoder = small_encoder()
    encoder([torch.randn(1, 1, 16, 4, 8)], [meta()])["bev_feats"].square().sum().backward()
    assert all(parameter.grad is not None for parameter in encoder.parameters())
    assert encoder.layers[0].cross_attn.height_offsets.weight.grad.any()


def test_a_cross_attention_that_moves_no_heights_is_refused():
    with pytest.raises(TypeError, match="needs HeightKernelAttention, got GeometryKernelAttention"):
        small_encoder(type="GeometryKernelAttention")


def test_kernels_start_with_equal_weights_as_released():
    assert not HeightKernelAttention(16, 4).attention_weights.weight.any()
