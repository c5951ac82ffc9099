"""Memory of Gaussians: transformation to the next frame, refinement, and fusion.

The memory of Gaussians is not in the paper. The published memory of queries propagates points.
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
    """Query memory for a head with Gaussians, which also propagates the Gaussians.

    Args:
        embed_dims: Channels C of the queries.
        covariance: Propagation of the Gaussians. ``"points"`` propagates only the centres, and each
            query starts with the initial Gaussian. ``"moved"`` transforms the Gaussians with the
            motion of the vehicle and adds the noise. ``"fused"`` also fuses the refined Gaussians
            with the transformed Gaussians of equal point index (`fuse_gaussians`).
        noise_m: Standard deviation of the drift of a Gaussian after one second, in metres. The
            variance grows linearly with time.
        noise_deg: Standard deviation of the drift of the heading after one second, in degrees.
        kwargs: Further arguments of `QueryMemory`.

    Raises:
        ValueError: If ``covariance`` is unknown, or a noise is negative.
    """

    def __init__(
        self,
        embed_dims: int,
        *,
        covariance: str = "fused",
        noise_m: float = 0.3,
        noise_deg: float = 1.0,
        **kwargs: Any,
    ) -> None:
        super().__init__(embed_dims, **kwargs)
        if covariance not in COVARIANCES:
            raise InputError(f"covariance must be one of {COVARIANCES}, got {covariance!r}.")
        if not (noise_m >= 0 and noise_deg >= 0):
            raise InputError(f"noise_m and noise_deg must be >= 0, got {noise_m} and {noise_deg}.")
        self.covariance = covariance
        self.noise_m = noise_m
        self.noise_rad = math.radians(noise_deg)

    def check(self, head: FlowHead) -> None:
        """Raise ValueError if the head has no Gaussians, too few layers or too few queries."""
        require_gaussians(self, head)
        super().check(head)

    def transform_references(self, head: FlowHead, references: Tensor, past: Past) -> Tensor:
        """Transform Gaussians of the previous frame to the current frame.

        Args:
            head: The head.
            references: References of the previous frame. (B, K, P, D)
            past: Memory of the previous frame, and the motion since.

        Returns:
            References of the current frame. (B, K, P, D)
        """
        points = super().transform_references(head, references, past)
        if self.covariance == "points":
            # Zeros encode the sigmas and theta of the initial Gaussian of a query.
            initial_gaussians = torch.zeros_like(points[..., -3:])
            return torch.cat([points[..., :-3], initial_gaussians], dim=-1)
        space = require_gaussians(self, head).space
        scale = past.seconds.sqrt()
        with torch.autocast(points.device.type, enabled=False):
            gaussians = move_gaussians(
                space.decode(references),
                motion=past.now_from_then,
                drift_m=self.noise_m * scale,
                drift_rad=self.noise_rad * scale,
            )
            return space.encode(gaussians, points)

    def fuse_references(self, refined: Tensor, transformed: Tensor, head: FlowHead) -> Tensor:
        """Fuse refined Gaussians with the transformed ones, if their centres are on the map.

        Args:
            refined: References refined by the decoder. (B, K, P, D)
            transformed: Transformed references of the previous frame. (B, K, P, D)
            head: The head.

        Returns:
            The fused references. (B, K, P, D)
        """
        if self.covariance != "fused":
            return refined
        space = require_gaussians(self, head).space
        with torch.autocast(refined.device.type, enabled=False):
            gaussians = fuse_gaussians(space.decode(transformed), space.decode(refined))
            fused = space.encode(gaussians, refined)
        # Centres outside of the map have been moved to its border, away from the element.
        distances = (transformed[..., :2] - 0.5).abs()  # distances from the middle of the map
        inside = distances.amax(-1, keepdim=True) < 0.5
        return torch.where(inside, fused, refined)
