"""Gaussians as memory: moved with their covariance, refined, then fused with what was remembered.

This is ours: the published memory of queries hands on points.
"""

import math
from typing import Any

import torch
from mmdet3d.registry import MODELS
from torch import Tensor

from gsmap.models.base.hooks import FlowHead
from gsmap.models.gsmap.reference import require_gaussians
from gsmap.models.streams.query_memory import QueryMemory
from gsmap.structures.gaussians import fuse_gaussians, move_gaussians
from gsmap.structures.past import Past
from gsmap.utils.errors import InputError

COVARIANCES = ("points", "moved", "fused")


@MODELS.register_module()
class GaussianMemory(QueryMemory):
    """`QueryMemory` of a head with Gaussians. Besides its arguments:

    Args:
        covariance: What becomes of the Gaussians that are handed on. ``"points"``: only their
            centres are, each starts with the Gaussian of a new query. ``"moved"``: they move and
            turn with the vehicle, and grow by the noise. ``"fused"``: so, and what the decoder has
            refined is fused with them (`fuse_gaussians`), point by point, in their order.
        noise_m: How far a remembered Gaussian has drifted after one second, standard deviation in
            metres; the variance grows with the time.
        noise_deg: The same for the vehicle's heading, in degrees.

    Raises:
        ValueError: If ``covariance`` is unknown, or a noise is negative.
    """

    def __init__(
        self,
        *args: Any,
        covariance: str = "fused",
        noise_m: float = 0.3,
        noise_deg: float = 1.0,
        **kwargs: Any,
    ) -> None:
        super().__init__(*args, **kwargs)
        if covariance not in COVARIANCES:
            raise InputError(f"covariance must be one of {COVARIANCES}, got {covariance!r}.")
        if not (noise_m >= 0 and noise_deg >= 0):
            raise InputError(f"noise_m and noise_deg must be >= 0, got {noise_m} and {noise_deg}.")
        self.covariance = covariance
        self.noise_m, self.noise_rad = noise_m, math.radians(noise_deg)

    def check(self, head: FlowHead) -> None:
        """Raise ValueError also if the head has no Gaussians."""
        require_gaussians(self, head)
        super().check(head)

    def transform_references(self, head: FlowHead, references: Tensor, past: Past) -> Tensor:
        """Transform Gaussians of the previous frame to the current one. (B, K, P, D)"""
        points = super().transform_references(head, references, past)
        if self.covariance == "points":
            return torch.cat([points[..., :-3], torch.zeros_like(points[..., -3:])], -1)
        space = require_gaussians(self, head).space
        spread = past.seconds.sqrt()
        with torch.autocast(points.device.type, enabled=False):
            gaussians = move_gaussians(
                space.decode(references),
                past.now_from_then,
                self.noise_m * spread,
                self.noise_rad * spread,
            )
            return space.encode(gaussians, points)

    def fuse_references(self, refined: Tensor, before: Tensor, head: FlowHead) -> Tensor:
        """Return refined Gaussians fused with those before, but where these left the map."""
        if self.covariance != "fused":
            return refined
        space = require_gaussians(self, head).space
        with torch.autocast(refined.device.type, enabled=False):
            gaussians = fuse_gaussians(space.decode(before), space.decode(refined))
            fused = space.encode(gaussians, refined)
        # a centre that left the map was put onto its border, where the element need not be
        inside = (before[..., :2] - 0.5).abs().amax(-1, keepdim=True) < 0.5
        return torch.where(inside, fused, refined)
