"""Memory of BEV features: moved by the vehicle's motion, then fused by a convolutional GRU."""

import torch
import torch.nn.functional as F
from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.structures.grid import BEVGrid


@MODELS.register_module()
class BEVMemory(nn.Module):
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
    """

    def __init__(self, grid: BEVGrid, embed_dims: int = 256, end_points: bool = False) -> None:
        super().__init__()
        self.grid, self.end_points = grid, end_points
        self.convz, self.convr, self.convq = (
            nn.Conv2d(2 * embed_dims, embed_dims, 1, bias=False) for _ in range(3)
        )
        self.ln = nn.LayerNorm(embed_dims)
        for conv in (self.convz, self.convr, self.convq):
            nn.init.kaiming_normal_(conv.weight, mode="fan_out", nonlinearity="relu")

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

        The motion (B, 4, 4), float64, takes metres now to metres then.
        """
        cells = self.cells(height, width).to(motion.device)
        moved = cells.flatten(0, 1) @ motion[:, :2, :2].transpose(1, 2) + motion[:, None, :2, 3]
        norm = self.grid.norm_from_metres(moved.unflatten(1, (height, width)))
        return 2 * norm - 1

    def warp(self, memory: Tensor, motion: Tensor) -> Tensor:
        """Move a memory to where its ground lies now; zero where it saw nothing. (B, C, H, W)"""
        places = self.places(motion, *memory.shape[-2:])
        return F.grid_sample(memory, places.to(memory), align_corners=False)

    def forward(
        self, feats: Tensor, memory: Tensor | None, motion: Tensor, continues: Tensor
    ) -> Tensor:
        """Return the fused features, which are the next frame's memory. (B, C, H, W)

        Args:
            feats: Features of now. (B, C, H, W)
            memory: Those of the frames before, without gradient; None if no stream continues.
                (B, C, H, W)
            motion: Takes metres now to metres then, float64. (B, 4, 4)
            continues: Which streams continue. (B,)
        """
        hidden = feats.detach()
        if memory is not None:
            warped = self.warp(memory.to(feats), motion)
            hidden = torch.where(continues.view(-1, 1, 1, 1), warped, hidden)
        joined = torch.cat([hidden, feats], 1)
        update, reset = self.convz(joined).sigmoid(), self.convr(joined).sigmoid()
        candidate = self.convq(torch.cat([reset * hidden, feats], 1))
        fused = (1 - update) * hidden + update * candidate
        return self.ln(fused.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)
