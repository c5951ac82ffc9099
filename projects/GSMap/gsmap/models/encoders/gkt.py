"""Geometry-guided kernel attention (GKT): BEV cells attend to a kernel of pixels in each image.

A kernel is the small window of pixels around the projection of a cell. (A compiled GPU function is
called "Triton kernel" below.)
"""

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
        Offsets (dx, dy) of the S pixels, in pixels. They are ordered by dx, then by dy. (S, 2)
    """
    rows, cols = kernel_size
    dx = torch.arange(cols) - cols // 2
    dy = torch.arange(rows) - rows // 2
    return torch.stack(torch.meshgrid(dx, dy, indexing="ij"), dim=-1).flatten(0, 1)


@MODELS.register_module()
class GeometryKernelAttention(nn.Module):
    """Attention from BEV cells to the pixels around their projections, one pillar height per head.

    A cell is visible in a camera if the projection of any height of its pillar lies in the image.
    It attends to these cameras with all heads, and the output is the mean over the cameras.

    Args:
        embed_dims: Channels C.
        num_heads: Number of heads; head m attends to pillar height m.
        kernel_size: Rows and columns of the kernel, odd unless ``bilinear``. The centre of a kernel
            with an even number of columns lies half a pixel to the left of the projection. With an
            even number of rows, it lies half a pixel above the projection.
        bilinear: Interpolate between pixels, which are zero outside the map, instead of rounding
            to the nearest pixel.
        released_cells: In all samples of a batch, a cell attends to the cameras in which it is
            visible in the first sample, as in the released code. The result of a sample then
            depends on its batch.
        equal_weights: Initialise to equal weights over the kernel, as GKT's code intends. In MapTR
            and its successors the weights start from Xavier's distribution, because their
            transformer initialises all matrices once more, after this module.

    Raises:
        ValueError: If a kernel size is even without ``bilinear``, or ``embed_dims`` is not a
            multiple of ``num_heads``.
    """

    offsets: Tensor
    # The code that captures CUDA graphs sets this to True, because in a graph the sizes of tensors
    # must not depend on values. All pairs of a cell and a camera are then computed, with weight 0
    # where the cell does not attend to the camera.
    fixed_sizes = False

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
            raise InputError(
                f"kernel_size must be odd, got {tuple(kernel_size)}; or set bilinear=True."
            )
        if embed_dims % num_heads:
            raise InputError(
                f"embed_dims must be divisible by num_heads, got {embed_dims} and {num_heads}."
            )
        self.num_heads = num_heads
        self.num_heights = num_heads  # read by the encoder, which projects one point per height
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

        With ``equal_weights``, the matrix of the attention weights is zero instead.
        """
        if self.equal_weights:
            constant_init(self.attention_weights, 0.0)
        else:
            xavier_init(self.attention_weights, distribution="uniform")
        xavier_init(self.value_proj, distribution="uniform")
        xavier_init(self.output_proj, distribution="uniform")

    def forward(self, query: Tensor, img_feats: Tensor, projection: PillarProjection) -> Tensor:
        """Attend from the cells to the cameras. The queries are not added to the output.

        Args:
            query: Queries of the cells. (B, Q, C)
            img_feats: Image features. (B, V, C, h, w)
            projection: Image coordinates of the pillars, with one point per head (``uv``), and the
                cameras in which each cell is visible (``visible``).

        Returns:
            Camera features of every cell. (B, Q, C)
        """
        height, width = img_feats.shape[-2:]
        value = self.value_proj(img_feats.flatten(3).transpose(2, 3))  # (B, V, h * w, C)
        # The softmax is computed in float32, also under autocast.
        logits = self.attention_weights(query).float().unflatten(-1, (self.num_heads, -1))
        weights = logits.softmax(-1)  # (B, Q, heads, S)
        visible = projection.visible
        pairs = visible  # pairs of a camera and a cell that attends to it, (B, V, Q)
        if self.released_cells:
            pairs = visible[:1].expand_as(visible)
        shape = (height, width)
        # Both branches compute equal sums. `sample_kernels` computes all pairs of a cell and a
        # camera, so the sizes of its tensors are fixed. If it has no Triton kernel for these
        # features (`has_kernel`), computing only the pairs that attend is cheaper.
        if self.fixed_sizes or has_kernel(value):
            maps = value.unflatten(-1, (self.num_heads, -1))  # (B, V, h * w, heads, C / heads)
            head_sums = sample_kernels(
                maps,
                shape,
                uv=projection.uv,
                visible_cells=pairs,
                weights=weights,
                offsets=self.offsets,
                bilinear=self.bilinear,
            )
            summed = head_sums.flatten(2)
        else:
            # The sums are in float32, as in `sample_kernels`.
            summed = self._sum_pairs(
                value.float(), shape=shape, uv=projection.uv, pairs=pairs, weights=weights
            )
        # Number of cameras in which a cell is visible, at least 1. It is counted in each
        # sample, even if the pairs come from the first sample (`released_cells`). (B, Q)
        count = visible.sum(1).clamp(min=1)
        return self.output_proj(summed / count[..., None])

    def _sum_pairs(
        self, value: Tensor, shape: tuple[int, int], uv: Tensor, pairs: Tensor, weights: Tensor
    ) -> Tensor:
        """Sum pixels of kernels over cameras like `sample_kernels`, but only for the given pairs.

        Args:
            value: Projected image features. (B, V, h * w, C)
            shape: Rows h and columns w of the feature maps.
            uv: Projection (x, y) of each cell for each head, [0, 1] over the image where the cell
                is visible. (B, V, Q, heads, 2)
            pairs: True where a cell attends to a camera. (B, V, Q)
            weights: Attention weights of the S pixels of the kernel. (B, Q, heads, S)

        Returns:
            Sums over cameras and kernel pixels. (B, Q, C)
        """
        batch, num_queries = weights.shape[:2]
        num_views, num_pixels = value.shape[1:3]
        sample, view, cell = pairs.nonzero(as_tuple=True)  # (T,) each, for T pairs
        # Row-major indices of the pixels of each kernel in its feature map, and their weights. With
        # `bilinear`, each of the S points has four pixels, so S below is four times as large.
        pixels, pair_weights = kernel_pixels(
            uv[sample, view, cell],
            self.offsets,
            weights=weights[sample, cell],
            shape=shape,
            bilinear=self.bilinear,
        )  # (T, heads, S) both
        image = (sample * num_views + view).view(-1, 1, 1)
        head = torch.arange(self.num_heads, device=value.device).view(1, -1, 1)
        # One row for each image, pixel and head, with the channels of the head.
        value_rows = value.reshape(-1, value.shape[-1] // self.num_heads)
        row_index = (image * num_pixels + pixels) * self.num_heads + head  # (T, heads, S)
        # `sum_rows` sums the S rows of each pair and head, multiplied by their weights.
        pair_sums = sum_rows(value_rows, row_index, pair_weights).flatten(1)  # (T, C)
        cell_index = sample * num_queries + cell
        summed = pair_sums.new_zeros(batch * num_queries, pair_sums.shape[-1])
        summed = summed.index_add(0, cell_index, pair_sums)
        return summed.view(batch, num_queries, -1)
