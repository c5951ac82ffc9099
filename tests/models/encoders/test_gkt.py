import pytest
import torch

from gsmap.models.encoders import gkt
from gsmap.models.encoders.gkt import GeometryKernelAttention, kernel_offsets
from gsmap.models.encoders.projection import PillarProjection
from gsmap.ops.kernel_sampling.reference import kernel_cells


def test_kernel_offsets_run_through_dy_first():
    expected = [[-1, -1], [-1, 0], [-1, 1], [0, -1], [0, 0], [0, 1], [1, -1], [1, 0], [1, 1]]
    assert kernel_offsets((3, 3)).tolist() == expected
    assert kernel_offsets((1, 3)).tolist() == [[-1, 0], [0, 0], [1, 0]]


def test_kernel_cells_round_half_to_even_and_replicate_the_border():
    # on a 4 x 8 map: x = 2.5 -> 2, y = 1.5 -> 2
    uv = torch.tensor([2.5 / 8, 1.5 / 4])
    assert kernel_cells(uv, torch.tensor([[0, 0]]), (4, 8)).tolist() == [2 * 8 + 2]
    # (0.99 * 8 + 2, 0.01 * 4 - 1) -> (7, 0) after clamping
    uv = torch.tensor([0.99, 0.01])
    assert kernel_cells(uv, torch.tensor([[2, -1]]), (4, 8)).tolist() == [7]


def naive_attention(module, query, img_feats, projection):
    """The definition, cell by cell and camera by camera."""
    batch, views, channels, height, width = img_feats.shape
    value = module.value_proj(img_feats.flatten(3).transpose(2, 3))  # (B, V, h * w, C)
    heads, size = module.num_heads, channels // module.num_heads
    out = torch.zeros_like(query)
    for b in range(batch):
        for q in range(query.shape[1]):
            weights = module.attention_weights(query[b, q]).view(heads, -1).softmax(-1)
            seeing = [v for v in range(views) if projection.visible[b, v, q]]
            for v in seeing:
                for m in range(heads):
                    cells = kernel_cells(projection.uv[b, v, q, m], module.offsets, (height, width))
                    part = value[b, v, cells, m * size : (m + 1) * size]
                    out[b, q, m * size : (m + 1) * size] += weights[m] @ part / len(seeing)
    return module.output_proj(out)


def test_attention_equals_its_definition():
    torch.manual_seed(0)
    module = GeometryKernelAttention(embed_dims=8, num_heads=2, kernel_size=(3, 5))
    torch.nn.init.normal_(module.attention_weights.weight)
    query, img_feats = torch.randn(2, 6, 8), torch.randn(2, 3, 8, 4, 7)
    projection = PillarProjection(torch.rand(2, 3, 6, 2, 2), torch.rand(2, 3, 6) < 0.5)
    projection.visible[:, :, 0] = False  # a cell that no camera sees
    expected = naive_attention(module, query, img_feats, projection)
    out = module(query, img_feats, projection)
    torch.testing.assert_close(out, expected)
    torch.testing.assert_close(out[:, 0], module.output_proj.bias.expand(2, -1))


@pytest.mark.parametrize("released_cells", [False, True])
@pytest.mark.parametrize("bilinear", [False, True])
def test_one_bag_a_cell_equals_the_pairs_of_cells_and_cameras(
    bilinear, released_cells, monkeypatch
):
    """What a GPU's kernel does, here by its reference."""
    torch.manual_seed(0)
    module = GeometryKernelAttention(8, 2, (3, 5), bilinear, released_cells)
    torch.nn.init.normal_(module.attention_weights.weight)
    query, img_feats = torch.randn(2, 6, 8), torch.randn(2, 3, 8, 4, 7)
    uv = torch.rand(2, 3, 6, 2, 2).requires_grad_(bilinear)
    projection = PillarProjection(uv, torch.rand(2, 3, 6) < 0.5)
    leaves = [*module.parameters(), *([uv] if bilinear else [])]
    results = []
    for kernel in (False, True):
        monkeypatch.setattr(gkt, "has_kernel", lambda value, kernel=kernel: kernel)
        out = module(query, img_feats, projection)
        results.append([out, *torch.autograd.grad(out.square().sum(), leaves)])
    # sums of some ten float32 products, in another order
    torch.testing.assert_close(*results, atol=1e-5, rtol=1e-5)


def test_attention_runs_when_no_camera_sees_anything():
    module = GeometryKernelAttention(embed_dims=8, num_heads=2)
    projection = PillarProjection(torch.rand(1, 2, 4, 2, 2), torch.zeros(1, 2, 4, dtype=torch.bool))
    out = module(torch.randn(1, 4, 8), torch.randn(1, 2, 8, 3, 3), projection)
    torch.testing.assert_close(out, module.output_proj.bias.expand(1, 4, -1))


def test_wrong_settings_are_refused():
    with pytest.raises(ValueError, match=r"odd, got \(2, 5\)"):
        GeometryKernelAttention(kernel_size=(2, 5))
    with pytest.raises(ValueError, match="divisible by num_heads, got 10 and 4"):
        GeometryKernelAttention(embed_dims=10)
