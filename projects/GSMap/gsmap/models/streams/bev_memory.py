"""Memory of BEV features: warped by the ego motion, then fused by a convolutional GRU."""

import math

import torch
import torch.nn.functional as F
from mmdet3d.registry import MODELS
from mmengine.model import constant_init
from torch import Tensor, nn

from gsmap.checkpoints.strict import AddsWeights
from gsmap.structures.grid import BEVGrid
from gsmap.structures.past import Past
from gsmap.utils.errors import InputError


@MODELS.register_module()
class BEVMemory(nn.Module, AddsWeights):
    r"""Fuses BEV features x with the warped memory h of the previous frame (Yuan et al. 2024).

    The output is the LayerNorm of :math:`(1 - z) h + z q` with :math:`z = \sigma(W_z [h, x])`,
    :math:`r = \sigma(W_r [h, x])` and :math:`q = W_q [r h, x]`, where W are 1 x 1 convolutions.
    Unlike in a GRU, the candidate q has no tanh, as in the released code. In the first frame of a
    stream, h is x without its gradient.

    Args:
        grid: Extent of the map.
        embed_dims: Channels C.
        end_points: Whether the centres of the outermost cells are placed on the edges of the map,
            as in the released code, instead of half a cell inside. The memory is then resampled
            even if the vehicle does not move. The released weights require True.
        kept_dims: Number of channels to remember, from the first on. In the other channels, h is
            equal to x. None remembers all channels, as published.
        present_share: Value of z in (0, 1) for an initialisation as a weighted mean of present and
            past, with q = x and no LayerNorm. A model that was trained without memory then keeps
            its features. None initialises random weights, as published.

    Raises:
        ValueError: If ``kept_dims`` is not in [1, C] or ``present_share`` not in (0, 1).
    """

    def __init__(
        self,
        grid: BEVGrid,
        embed_dims: int = 256,
        end_points: bool = False,
        kept_dims: int | None = None,
        present_share: float | None = None,
    ) -> None:
        super().__init__()
        if kept_dims is not None and not 0 < kept_dims <= embed_dims:
            raise InputError(
                f"temporal.bev.kept_dims must be 1 to {embed_dims}, the channels of the map's "
                f"features, got {kept_dims}."
            )
        if present_share is not None and not 0 < present_share < 1:
            raise InputError(
                f"temporal.bev.present_share must lie between 0 and 1, got {present_share}."
            )
        self.grid = grid
        self.embed_dims = embed_dims
        self.end_points = end_points
        self.kept_dims = kept_dims
        published = present_share is None
        self.neutral_keys = () if published else ("conv",)  # a checkpoint may lack these weights
        self.convz = nn.Conv2d(2 * embed_dims, embed_dims, kernel_size=1, bias=not published)
        self.convr = nn.Conv2d(2 * embed_dims, embed_dims, kernel_size=1, bias=False)
        self.convq = nn.Conv2d(2 * embed_dims, embed_dims, kernel_size=1, bias=False)
        self.ln = nn.LayerNorm(embed_dims) if published else nn.Identity()
        for conv in (self.convz, self.convr, self.convq):
            nn.init.kaiming_normal_(conv.weight, mode="fan_out", nonlinearity="relu")
        if present_share is not None:
            logit = math.log(present_share / (1 - present_share))
            constant_init(self.convz, 0.0, bias=logit)
            with torch.no_grad():
                self.convq.weight.zero_()
                present_weights = self.convq.weight[:, embed_dims:, 0, 0]  # (C, C)
                present_weights.fill_diagonal_(1.0)

    def cells(self, height: int, width: int) -> Tensor:
        """Positions of the cells.

        Args:
            height: Rows H of the features.
            width: Columns W of the features.

        Returns:
            Points in metres, float64. (H, W, 2)
        """
        if not self.end_points:
            return self.grid.with_size(height, width).pixel_centres(dtype=torch.float64)
        low_x, high_x = self.grid.x_range
        low_y, high_y = self.grid.y_range
        x = torch.linspace(low_x, high_x, width, dtype=torch.float64)
        y = torch.linspace(low_y, high_y, height, dtype=torch.float64)
        return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)

    def source_locations(self, motion: Tensor, height: int, width: int) -> Tensor:
        """Sampling locations of the cells in the features of the previous frame.

        Args:
            motion: Transform from the current to the previous frame, in metres. (B, 4, 4)
            height: Rows H of the features.
            width: Columns W of the features.

        Returns:
            Locations for ``grid_sample``, [-1, 1] over the map. (B, H, W, 2)
        """
        cells = self.cells(height, width).to(motion)
        # The cells are row vectors, so they are multiplied by the transposed rotation.
        rotation = motion[:, :2, :2].transpose(1, 2)
        previous = cells.flatten(0, 1) @ rotation + motion[:, None, :2, 3]
        norm = self.grid.norm_from_metres(previous.unflatten(1, (height, width)))
        return 2 * norm - 1  # [0, 1] -> [-1, 1]

    def warp(self, memory: Tensor, motion: Tensor) -> Tensor:
        """Resample features of the previous frame at the cells of the current frame.

        Args:
            memory: Features of the previous frame. (B, C, H, W)
            motion: Transform from the current to the previous frame, in metres. (B, 4, 4)

        Returns:
            Features of the current cells; zero outside of the previous map. (B, C, H, W)
        """
        height, width = memory.shape[-2:]
        locations = self.source_locations(motion, height=height, width=width)
        return F.grid_sample(memory, locations.to(memory), align_corners=False)

    def forward(self, feats: Tensor, past: Past) -> Tensor:
        """Fuse BEV features with the memory.

        Args:
            feats: BEV features of the current frame. (B, C, H, W)
            past: Memory of the streams, with the result of `remember` as ``bev_feats``, and the ego
                motion.

        Returns:
            The fused features. (B, C, H, W)

        Raises:
            ValueError: If the number of channels differs from ``embed_dims``.
        """
        if feats.shape[1] != self.embed_dims:
            raise InputError(
                f"the map's features have {feats.shape[1]} channels, and their memory has "
                f"{self.embed_dims}: set temporal.embed_dims={feats.shape[1]}."
            )
        hidden = feats.detach()
        memory = past.memory.get("bev_feats")
        if memory is not None:
            warped = self.warp(memory.to(feats), past.then_from_now)
            if self.kept_dims is not None:
                warped = torch.cat([warped, hidden[:, self.kept_dims :]], dim=1)
            # Streams that start keep the features of the current frame.
            hidden = torch.where(past.continues.view(-1, 1, 1, 1), warped, hidden)
        inputs = torch.cat([hidden, feats], dim=1)
        update = self.convz(inputs).sigmoid()
        reset = self.convr(inputs).sigmoid()
        candidate = self.convq(torch.cat([reset * hidden, feats], dim=1))
        fused = torch.lerp(hidden, candidate, update)  # (1 - z) h + z q
        fused = self.ln(fused.permute(0, 2, 3, 1))  # (B, H, W, C)
        return fused.permute(0, 3, 1, 2)

    def remember(self, fused: Tensor) -> Tensor:
        """Memory for the next frame. (B, C, H, W) -> (B, kept_dims, H, W)

        If ``kept_dims`` is None, the memory has all C channels.
        """
        return fused.detach()[:, : self.kept_dims]
