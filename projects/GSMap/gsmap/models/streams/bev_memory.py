"""Memory of BEV features: moved by the vehicle's motion, then fused by a convolutional GRU."""

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
    r"""Fuse the features of now, x, with those of the frame before, h (StreamMapNet).

    :math:`z = \sigma(W_z [h, x])`, :math:`r = \sigma(W_r [h, x])`, :math:`q = W_q [r h, x]`
    and LayerNorm of :math:`(1 - z) h + z q`, all by convolutions of 1 x 1. Differs from a GRU: the
    released candidate q has no tanh. In a stream's first frame h is x without its gradient.

    Args:
        grid: The map's extent.
        embed_dims: Channels C.
        end_points: Take the cells to lie from edge to edge of the map, as released, instead of at
            their centres. Then the memory of a standing vehicle moves too; the released weights
            need it.
        kept_dims: Channels that are kept, the first ones; the others of h are those of x, as in a
            first frame. None keeps all, as published.
        present_share: Start as a mean of present and past, z everywhere at this share and q = x,
            without LayerNorm: then a model that was trained without memory still knows its
            features. None starts from random weights, as published.

    Raises:
        ValueError: If there are not as many channels to keep, or a share is not within (0, 1).
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
        self.grid, self.embed_dims = grid, embed_dims
        self.end_points, self.kept_dims = end_points, kept_dims
        published = present_share is None
        self.neutral_keys = () if published else ("conv",)  # a checkpoint may lack them
        self.convz, self.convr, self.convq = (
            nn.Conv2d(2 * embed_dims, embed_dims, 1, bias=bias)
            for bias in (not published, False, False)
        )
        self.ln = nn.LayerNorm(embed_dims) if published else nn.Identity()
        for conv in (self.convz, self.convr, self.convq):
            nn.init.kaiming_normal_(conv.weight, mode="fan_out", nonlinearity="relu")
        if present_share is not None:
            constant_init(self.convz, 0.0, math.log(present_share / (1 - present_share)))
            with torch.no_grad():
                self.convq.weight.zero_()
                self.convq.weight[:, embed_dims:, 0, 0].fill_diagonal_(1.0)

    def cells(self, height: int, width: int) -> Tensor:
        """Return where the cells lie, in metres, float64. (H, W, 2)"""
        if not self.end_points:
            return self.grid.resized(height, width).pixel_centres(dtype=torch.float64)
        x, y = (
            torch.linspace(*ends, steps, dtype=torch.float64)
            for ends, steps in ((self.grid.x_range, width), (self.grid.y_range, height))
        )
        return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)

    def places(self, motion: Tensor, height: int, width: int) -> Tensor:
        """Return where each cell's ground lay in the frame before, [-1, 1]. (B, H, W, 2)

        The motion (B, 4, 4) takes metres now to metres then.
        """
        cells = self.cells(height, width).to(motion)
        moved = cells.flatten(0, 1) @ motion[:, :2, :2].transpose(1, 2) + motion[:, None, :2, 3]
        norm = self.grid.norm_from_metres(moved.unflatten(1, (height, width)))
        return 2 * norm - 1

    def warp(self, memory: Tensor, motion: Tensor) -> Tensor:
        """Move a memory to where its ground lies now; zero where it saw nothing. (B, C, H, W)"""
        places = self.places(motion, *memory.shape[-2:])
        return F.grid_sample(memory, places.to(memory), align_corners=False)

    def forward(self, feats: Tensor, past: Past) -> Tensor:
        """Return the features of now (B, C, H, W), fused with those of the frames before.

        ValueError if they have other channels than the memory.
        """
        if feats.shape[1] != self.embed_dims:
            raise InputError(
                f"the map's features have {feats.shape[1]} channels, their memory "
                f"{self.embed_dims}: set temporal.embed_dims={feats.shape[1]}."
            )
        hidden = feats.detach()
        memory = past.memory.get("bev_feats")
        if memory is not None:
            warped = self.warp(memory.to(feats), past.then_from_now)
            if self.kept_dims is not None:
                warped = torch.cat([warped, hidden[:, self.kept_dims :]], 1)
            hidden = torch.where(past.continues.view(-1, 1, 1, 1), warped, hidden)
        joined = torch.cat([hidden, feats], 1)
        update, reset = self.convz(joined).sigmoid(), self.convr(joined).sigmoid()
        candidate = self.convq(torch.cat([reset * hidden, feats], 1))
        fused = torch.lerp(hidden, candidate, update)
        return self.ln(fused.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)

    def kept(self, fused: Tensor) -> Tensor:
        """Return what the next frame remembers of fused features. (B, C, H, W)"""
        return fused.detach()[:, : self.kept_dims]
