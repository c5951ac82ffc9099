"""BEV encoder of MapQR (GKT-h): kernel attention at pillar heights that every layer refines."""

from collections.abc import Sequence
from typing import Any

import torch
from mmdet3d.registry import MODELS
from mmengine.model import constant_init
from torch import Tensor, nn

from gsmap.models.encoders.bev_query_encoder import BEVQueryEncoder
from gsmap.models.encoders.gkt import GeometryKernelAttention
from gsmap.models.encoders.projection import PillarProjection, pillar_points, visible_points
from gsmap.structures.tensors import at_least_float32
from gsmap.utils.errors import InputTypeError


class MovingPillars:
    """Pillars of a batch with variable heights, which the layers of the encoder refine in turn.

    A pillar is a column of Z points above the centre of a BEV cell.

    Args:
        feet: Homogeneous cell centres at z = 0, in metres. (Q, 4)
        start: Initial heights, [0, 1] over ``z_range``. (Z,)
        z_range: Lowest and highest z in metres.
        img_from_frame: Matrices from metres to pixels. (B, V, 4, 4)
        img_shape: Rows and columns of the padded images.

    Attributes:
        heights: Current heights, [0, 1] over ``z_range``, not clipped. (B, Q, Z), initially (Z,)
        feet: Projections of the argument ``feet``, as homogeneous image points. (B, V, Q, 4)
        upwards: Change of a homogeneous image point per metre of height. (B, V, 1, 1, 4)
    """

    def __init__(
        self,
        feet: Tensor,
        start: Tensor,
        z_range: Sequence[float],
        img_from_frame: Tensor,
        img_shape: tuple[int, int],
    ) -> None:
        self.start = start
        self.heights = start  # `move` replaces them
        self.low_m = z_range[0]
        self.extent_m = z_range[1] - z_range[0]
        self.img_shape = img_shape
        matrices = img_from_frame.float()
        # Half precision would move the projections by pixels.
        with torch.autocast(feet.device.type, enabled=False):
            self.feet = feet @ matrices.transpose(-1, -2)
        self.upwards = matrices[:, :, None, None, :, 2]  # the column that is multiplied by z

    def move(self, offsets_m: Tensor, accumulate: bool) -> PillarProjection:
        """Add offsets to the heights and project the pillars.

        Args:
            offsets_m: Offsets in metres. (B, Q, Z)
            accumulate: Whether the offsets are added to the current heights. Otherwise, they are
                added to the initial ones.

        Returns:
            Points in the images, [0, 1] over the padded images (B, V, Q, Z, 2), and whether any
            point of a pillar is visible to a camera (B, V, Q).
        """
        old_heights = self.heights if accumulate else self.start
        self.heights = old_heights + at_least_float32(offsets_m) / self.extent_m
        heights_m = self.low_m + self.heights * self.extent_m
        z = heights_m[:, None, ..., None]  # (B, 1, Q, Z, 1)
        projected = self.feet[:, :, :, None] + z * self.upwards  # (B, V, Q, Z, 4)
        return visible_points(projected, self.img_shape)


@MODELS.register_module()
class HeightKernelAttention(GeometryKernelAttention):
    """Geometry kernel attention with predicted offsets of the pillar heights (MapQR).

    Kernels are sampled bilinearly. If any point of a cell is visible in a camera, all its points
    are used.

    Args:
        embed_dims: Channels C.
        num_heads: Number of heads; head m attends to pillar height m.
        kernel_size: Rows and columns of the kernel.
        accumulate_heights: Whether offsets are added to the heights of the previous layer, as in
            the released code. Otherwise, they are added to the evenly spaced heights.
        released_cells: Whether the visible cells of the first sample of the batch are used for all
            samples (`GeometryKernelAttention`).
        equal_weights: Whether the initial weights over the kernel are equal
            (`GeometryKernelAttention`), as in the released code.
    """

    def __init__(
        self,
        embed_dims: int = 256,
        num_heads: int = 8,
        kernel_size: tuple[int, int] = (2, 4),
        accumulate_heights: bool = True,
        released_cells: bool = False,
        equal_weights: bool = True,
    ) -> None:
        super().__init__(
            embed_dims,
            num_heads=num_heads,
            kernel_size=kernel_size,
            bilinear=True,
            released_cells=released_cells,
            equal_weights=equal_weights,
        )
        self.accumulate_heights = accumulate_heights
        self.height_offsets = nn.Linear(embed_dims, num_heads)
        constant_init(self.height_offsets, 0.0)

    def forward(  # type: ignore[override]
        self, query: Tensor, img_feats: Tensor, pillars: MovingPillars
    ) -> Tensor:
        """Refine the pillar heights, then attend to the projected pillars.

        Args:
            query: Queries of the cells. (B, Q, C)
            img_feats: Image features. (B, V, C, h, w)
            pillars: Pillars of the batch; their heights are changed in place.

        Returns:
            Camera features of every cell. (B, Q, C)
        """
        projection = pillars.move(self.height_offsets(query), self.accumulate_heights)
        return super().forward(query, img_feats, projection)


@MODELS.register_module()
class HeightQueryEncoder(BEVQueryEncoder):
    """BEV encoder of MapQR: `BEVQueryEncoder` with `HeightKernelAttention`.

    The initial heights are spaced evenly over ``z_range``, ends included.

    Args:
        cross_attn: Config of the camera cross-attention of every layer (`HeightKernelAttention`).
        kwargs: Further arguments of `BEVQueryEncoder`.

    Raises:
        TypeError: If the cross-attention is not a `HeightKernelAttention`.
    """

    def __init__(self, cross_attn: dict[str, Any] | None = None, **kwargs: Any) -> None:
        super().__init__({"type": HeightKernelAttention, **(cross_attn or {})}, **kwargs)
        kind = type(next(iter(self.layers)).cross_attn)  # all layers have one config
        if not issubclass(kind, HeightKernelAttention):
            raise InputTypeError(
                f"HeightQueryEncoder needs HeightKernelAttention, got {kind.__name__}: set "
                "bev_encoder.cross_attn.type, or take BEVQueryEncoder."
            )

    def project(  # type: ignore[override]
        self, img_from_frame: Tensor, img_shape: tuple[int, int]
    ) -> MovingPillars:
        """Pillars of a batch at their initial heights.

        Args:
            img_from_frame: Matrices from metres to pixels. (B, V, 4, 4)
            img_shape: Rows and columns of the padded images.
        """
        device = img_from_frame.device
        # Pillars with one point at z = 0, which are the centres of the cells.
        feet = pillar_points(self.grid, z_range=(0.0, 0.0), num_heights=1, device=device)[:, 0]
        return MovingPillars(
            feet,  # (Q, 4)
            # `num_heights` is the number of heads of the cross-attention.
            start=torch.linspace(0, 1, self.num_heights, device=device),
            z_range=self.z_range,
            img_from_frame=img_from_frame,
            img_shape=img_shape,
        )
