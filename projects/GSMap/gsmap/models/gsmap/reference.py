"""A Gaussian per query as what the decoder's layers refine (GSMap Eqs. 1, 8)."""

from collections.abc import Sequence
from typing import Any

import torch
from mmdet3d.registry import MODELS
from mmengine.model import constant_init
from torch import Tensor, nn

from gsmap.checkpoints.strict import AddsWeights
from gsmap.models.base import layers
from gsmap.models.base.pairs import BuiltHead
from gsmap.models.gsmap.coder import GaussianCoder
from gsmap.models.maptr.references import PointReference
from gsmap.ops.gaussian_raster import render_gaussians
from gsmap.structures.gaussians import Gaussians, GaussianSpace
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError


@MODELS.register_module()
class GaussianReference(PointReference, AddsWeights):
    """A Gaussian per query: its centre is the point, sigma and theta follow it (GSMap Eq. 1).

    What it adds to points starts neutral: every query has the same Gaussian, every layer leaves it.
    The points may have a height, the Gaussians lie in the plane. Besides `PointReference`'s:

    Args:
        mlp: Predict sigma and theta by branches like the points' (GSMap Eq. 8) in place of one
            linear layer each.
        space: Settings of `GaussianSpace`: ``min_scale_m`` and so on.
    """

    space: GaussianSpace
    coder_class = GaussianCoder
    neutral_keys: tuple[str, ...] = ("gaussian_init.", "gaussian_branches.")

    outputs = ("pts", "scales", "rotations")

    def __init__(
        self,
        grid: BEVGrid,
        embed_dims: int = 256,
        num_layers: int = 6,
        mlp: bool = False,
        coords: int = 2,
        z_range: Sequence[float] | None = None,
        points_per_state: int = 1,
        **space: Any,
    ) -> None:
        super().__init__(grid, embed_dims, num_layers, coords, z_range, points_per_state)
        self.space = GaussianSpace(grid, **space)
        self.metainfo = {"min_scale_m": self.space.floor_m}
        self.gaussian_init = nn.Linear(embed_dims, 3 * points_per_state)
        hidden = [embed_dims, embed_dims] if mlp else []
        self.gaussian_branches = nn.ModuleList(
            layers.mlp(embed_dims, *hidden, 3 * points_per_state) for _ in range(num_layers)
        )
        self.reset_gaussian_parts()

    def init_weights(self) -> None:
        """Initialise as for points; what the Gaussians add starts neutral."""
        super().init_weights()
        self.reset_gaussian_parts()

    def reset_gaussian_parts(self) -> None:
        """Let every query start with the same Gaussian, and every layer leave it as it is."""
        constant_init(self.gaussian_init, 0.0)
        for branch in self.gaussian_branches:
            *_, last = branch.children()
            constant_init(last, 0.0)

    def start(self, query_pos: Tensor) -> Tensor:
        """Return the Gaussians that the first layer starts from. (..., C) -> (..., D)"""
        shapes = self.by_point(self.gaussian_init(query_pos))
        return torch.cat([super().start(query_pos), shapes], -1)

    def refine(self, layer: int, point_states: Tensor, reference: Tensor) -> Tensor:
        """Return the Gaussians after a layer (Eq. 8). (..., C), (..., D) -> (..., D)"""
        points = super().refine(layer, point_states, reference[..., : self.coords])
        changes = self.by_point(self.gaussian_branches[layer](point_states))
        return torch.cat([points, reference[..., self.coords :] + changes], -1)

    def transform_references(self, references: Tensor, motion: Tensor) -> Tensor:
        """Return Gaussians of an earlier frame as they lie now, turned with the vehicle."""
        moved = super().transform_references(references, motion)
        turn = torch.atan2(motion[:, 1, 0], motion[:, 0, 0]).to(moved)
        turn = turn.view(-1, *[1] * (moved.dim() - 1)).expand_as(moved[..., :1])
        return torch.cat([moved[..., :-1], moved[..., -1:] + turn], -1)

    def errors(self, references: Tensor) -> Gaussians:
        """Return the Gaussians that stand for the points' errors. (..., P, D) -> (..., P)"""
        return self.space.decode(references)

    def decode(self, references: Tensor) -> dict[str, Tensor]:
        """Add the Gaussians' ``scales`` (N, P, 2) in metres and ``rotations`` (N, P) in radians."""
        gaussians = self.errors(references)
        shapes = {"scales": gaussians.scales, "rotations": gaussians.rotations}
        return super().decode(references) | shapes

    def render(self, references: Tensor, grid: BEVGrid) -> Tensor:
        """Render the masks of elements (GSMap Eq. 6). (..., P, D) -> (..., H, W)"""
        means, scales, rotations = self.space.decode(references)
        return render_gaussians(means, scales, rotations, grid)


def require_gaussians(part: Any, head: BuiltHead) -> GaussianReference:
    """Return a head's Gaussians; ValueError if a part of a model needs them and gets points."""
    if isinstance(head.reference, GaussianReference):
        return head.reference
    raise InputError(
        f"{type(part).__name__} needs Gaussians, got {type(head.reference).__name__}: set "
        "reference=dict(type='GaussianReference'), or take GSMapHead."
    )
