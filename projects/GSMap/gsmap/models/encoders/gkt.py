"""Geometry-guided kernel attention (GKT): fixed kernels around projected cells."""

import torch
from mmdet3d.registry import MODELS
from mmengine.model import constant_init, xavier_init
from torch import Tensor, nn

from gsmap.models.encoders.projection import PillarProjection
from gsmap.ops.deformable_sampling import sum_rows
from gsmap.ops.kernel_sampling import has_kernel, sample_kernels
from gsmap.ops.kernel_sampling.reference import kernel_pixels
from gsmap.utils.errors import InputError


def kernel_offsets(kernel_size: tuple[int, int]) -> Tensor:
    """Offsets of the pixels of a kernel from its centre.

    Args:
        kernel_size: Rows and columns of the kernel.

    Returns:
        Offsets (dx, dy) in pixels in the order of the attention weights, dy fastest. (S, 2)
    """
    rows, cols = kernel_size
    dx = torch.arange(cols) - cols // 2
    dy = torch.arange(rows) - rows // 2
    return torch.stack(torch.meshgrid(dx, dy, indexing="ij"), dim=-1).flatten(0, 1)


@MODELS.register_module()
class GeometryKernelAttention(nn.Module):
    """Attention from BEV cells to the pixels around their projections, one pillar height per head.

    Only pairs of a cell and a camera in which it is visible are computed. Sums over cameras are
    divided by the number of cameras in which the cell is visible.

    Args:
        embed_dims: Channels C.
        num_heads: Number of heads; head m attends to pillar height m.
        kernel_size: Rows and columns of the kernel. An even kernel, which needs ``bilinear``, lies
            half a pixel to the left and up.
        bilinear: Sample between pixels instead of at the nearest one; zero outside the map.
        released_cells: Use the visible cells of the first sample of the batch for all samples, as
            in the released code. The result of a sample then depends on its batch.
        equal_weights: Start from equal weights over the kernel, as GKT's code intends. In MapTR and
            its successors they start from Xavier's distribution, because the transformer around
            them initialises all matrices later.

    Raises:
        ValueError: If a kernel size is even without ``bilinear``, or ``embed_dims`` is not a
            multiple of ``num_heads``.
    """

    offsets: Tensor
    fixed_sizes = False  # whether invisible pairs of cell and camera are computed, with weight 0

    def __init__(
        self,
        embed_dims: int = 256,
        num_heads: int = 4,
        kernel_size: tuple[int, int] = (3, 5),
        bilinear: bool = False,
        released_cells: bool = False,
        equal_weights: bool = False,
    ) -> None:
        super().__init__()
        if not bilinear and any(size % 2 == 0 for size in kernel_size):
            raise InputError(f"kernel_size must be odd, got {tuple(kernel_size)}.")
        if embed_dims % num_heads:
            raise InputError(
                f"embed_dims must be divisible by num_heads, got {embed_dims} and {num_heads}."
            )
        self.num_heads = self.num_heights = num_heads
        self.bilinear = bilinear
        self.released_cells = released_cells
        self.equal_weights = equal_weights
        self.register_buffer("offsets", kernel_offsets(kernel_size), persistent=False)
        self.attention_weights = nn.Linear(embed_dims, num_heads * len(self.offsets))
        self.value_proj = nn.Linear(embed_dims, embed_dims)
        self.output_proj = nn.Linear(embed_dims, embed_dims)
        self.init_weights()

    def init_weights(self) -> None:
        """Initialise all matrices from Xavier's uniform distribution.

        With ``equal_weights``, the attention weights start from zero logits.
        """
        if self.equal_weights:
            constant_init(self.attention_weights, 0.0)
        else:
            xavier_init(self.attention_weights, distribution="uniform")
        xavier_init(self.value_proj, distribution="uniform")
        xavier_init(self.output_proj, distribution="uniform")

    def forward(self, query: Tensor, img_feats: Tensor, projection: PillarProjection) -> Tensor:
        """Attend from the cells to the cameras, without the residual.

        Args:
            query: Queries of the cells. (B, Q, C)
            img_feats: Image features. (B, V, C, h, w)
            projection: Image coordinates of pillars with one point per head.

        Returns:
            Camera features of every cell. (B, Q, C)
        """
        height, width = img_feats.shape[-2:]
        value = self.value_proj(img_feats.flatten(3).transpose(2, 3))  # (B, V, h * w, C)
        logits = self.attention_weights(query).float().unflatten(-1, (self.num_heads, -1))
        weights = logits.softmax(-1)  # (B, Q, heads, S)
        visible = projection.visible
        pairs = visible[:1].expand_as(visible) if self.released_cells else visible
        shape = (height, width)
        if self.fixed_sizes or has_kernel(value):
            maps = value.unflatten(-1, (self.num_heads, -1))
            summed = sample_kernels(
                maps, shape, projection.uv, pairs, weights, self.offsets, self.bilinear
            ).flatten(2)
        else:
            summed = self._sum_pairs(
                value.float(), shape=shape, uv=projection.uv, pairs=pairs, weights=weights
            )
        count = visible.sum(1).clamp(min=1)  # (B, Q)
        return self.output_proj(summed / count[..., None])

    def _sum_pairs(
        self, value: Tensor, shape: tuple[int, int], uv: Tensor, pairs: Tensor, weights: Tensor
    ) -> Tensor:
        """Sum kernels over cameras as `sample_kernels` does, computing the visible pairs only.

        Args:
            value: Projected image features. (B, V, h * w, C)
            shape: Rows h and columns w of the feature maps.
            uv: Projected pillars, [0, 1] over the image. (B, V, Q, heads, 2)
            pairs: Whether a cell attends to a camera. (B, V, Q)
            weights: Attention weights over the kernel. (B, Q, heads, S)

        Returns:
            The sums. (B, Q, C)
        """
        batch, num_queries = weights.shape[:2]
        num_views, num_pixels = value.shape[1:3]
        sample, view, cell = pairs.nonzero(as_tuple=True)  # T pairs
        pixels, pair_weights = kernel_pixels(
            uv[sample, view, cell], self.offsets, weights[sample, cell], shape, self.bilinear
        )  # (T, heads, S)
        image = (sample * num_views + view).view(-1, 1, 1)
        head = torch.arange(self.num_heads, device=value.device).view(1, -1, 1)
        rows = (image * num_pixels + pixels) * self.num_heads + head
        table = value.reshape(-1, value.shape[-1] // self.num_heads)
        out = sum_rows(table, rows, pair_weights).flatten(1)  # (T, C)
        target = sample * num_queries + cell
        summed = out.new_zeros(batch * num_queries, out.shape[-1]).index_add(0, target, out)
        return summed.view(batch, num_queries, -1)
