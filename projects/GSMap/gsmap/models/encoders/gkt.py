"""Geometry-guided kernel attention (GKT) in plain torch: fixed kernels around projected cells."""

import torch
from mmdet3d.registry import MODELS
from mmengine.model import constant_init, xavier_init
from torch import Tensor, nn

from gsmap.models.encoders.projection import PillarProjection
from gsmap.ops.deformable_sampling import bilinear_cells, sum_rows


def kernel_offsets(kernel_size: tuple[int, int]) -> Tensor:
    """Return a kernel's offsets (dx, dy) in pixels, in the order of its weights, dx slow. (S, 2)"""
    rows, cols = kernel_size
    dx = torch.arange(cols) - cols // 2
    dy = torch.arange(rows) - rows // 2
    return torch.stack(torch.meshgrid(dx, dy, indexing="ij"), -1).flatten(0, 1)


def kernel_cells(uv: Tensor, offsets: Tensor, shape: tuple[int, int]) -> Tensor:
    """Return the feature pixels under a kernel centred at projected points, borders replicated.

    Coordinates are rounded half to even after the offset is added, without a half-pixel shift, as
    the original does. Points in [0, 1] (..., 2), offsets (dx, dy) in pixels (S, 2) -> (..., S)
    """
    height, width = shape
    position = uv * uv.new_tensor([width, height])
    return border_pixels(torch.round(position[..., None, :] + offsets.to(uv)), shape)


def border_pixels(position: Tensor, shape: tuple[int, int]) -> Tensor:
    """Return row-major indices of pixels (x, y), moved onto the map. (..., 2) -> (...)"""
    height, width = shape
    cols, rows = position[..., 0].clamp(0, width - 1), position[..., 1].clamp(0, height - 1)
    return (rows * width + cols).long()


@MODELS.register_module()
class GeometryKernelAttention(nn.Module):
    """Attention from BEV cells to the pixels around their projections, one pillar height per head.

    Only pairs of a cell and a camera that sees it are computed. Sums over cameras are divided by
    the number of cameras that see the cell.

    Args:
        embed_dims: Channels C; ValueError if they are not divisible by ``num_heads``.
        num_heads: Number of heads; head m looks at pillar height m.
        kernel_size: Rows and columns of the kernel; ValueError if they are not odd and pixels are
            not bilinear. An even kernel lies half a pixel to the left and up.
        bilinear: Sample between pixels (MapQR), in place of rounding to one; zero outside the map.
        released_cells: Let each camera serve the cells that it sees in the first sample of the
            batch, as released; a sample's result then depends on its batch.
    """

    offsets: Tensor

    def __init__(
        self,
        embed_dims: int = 256,
        num_heads: int = 4,
        kernel_size: tuple[int, int] = (3, 5),
        bilinear: bool = False,
        released_cells: bool = False,
    ) -> None:
        super().__init__()
        if not bilinear and any(size % 2 == 0 for size in kernel_size):
            raise ValueError(f"kernel_size must be odd, got {tuple(kernel_size)}.")
        if embed_dims % num_heads:
            raise ValueError(
                f"embed_dims must be divisible by num_heads, got {embed_dims} and {num_heads}."
            )
        self.num_heads = self.num_heights = num_heads
        self.bilinear, self.released_cells = bilinear, released_cells
        self.register_buffer("offsets", kernel_offsets(kernel_size), persistent=False)
        self.attention_weights = nn.Linear(embed_dims, num_heads * len(self.offsets))
        self.value_proj = nn.Linear(embed_dims, embed_dims)
        self.output_proj = nn.Linear(embed_dims, embed_dims)
        self.init_weights()

    def init_weights(self) -> None:
        """Start from equal weights over the kernel."""
        constant_init(self.attention_weights, 0.0)
        xavier_init(self.value_proj, distribution="uniform")
        xavier_init(self.output_proj, distribution="uniform")

    def forward(self, query: Tensor, img_feats: Tensor, projection: PillarProjection) -> Tensor:
        """Collect camera features (B, V, C, h, w) for every cell's query, without the residual.

        The projected pillars have as many points as there are heads. (B, Q, C) -> (B, Q, C)
        """
        batch, num_queries = query.shape[:2]
        num_views, (height, width) = img_feats.shape[1], img_feats.shape[-2:]
        value = self.value_proj(img_feats.flatten(3).transpose(2, 3))  # (B, V, h * w, C)
        logits = self.attention_weights(query).float().unflatten(-1, (self.num_heads, -1))
        visible = projection.visible
        served = visible[:1].expand_as(visible) if self.released_cells else visible
        sample, view, cell = served.nonzero(as_tuple=True)  # T pairs
        uv = projection.uv[sample, view, cell]  # (T, heads, 2)
        weights = logits.softmax(-1)[sample, cell]  # (T, heads, S)
        if self.bilinear:
            places = uv[:, :, None] + self.offsets / uv.new_tensor([width, height])
            pixels, weights = bilinear_cells(places, weights, (height, width))  # (T, heads, 4 S)
        else:
            pixels = kernel_cells(uv, self.offsets, (height, width))
        image = (sample * num_views + view).view(-1, 1, 1)
        head = torch.arange(self.num_heads, device=query.device).view(1, -1, 1)
        rows = (image * (height * width) + pixels) * self.num_heads + head
        table = value.float().reshape(-1, value.shape[-1] // self.num_heads)
        out = sum_rows(table, rows, weights).flatten(1)  # (T, C)
        target = sample * num_queries + cell
        summed = out.new_zeros(batch * num_queries, out.shape[-1]).index_add(0, target, out)
        count = visible.sum(1).clamp(min=1)  # (B, Q)
        return self.output_proj(summed.view(batch, num_queries, -1) / count[..., None])
