"""Memory of Gaussians: transformation to the next frame, refinement, and fusion.

The memory of Gaussians is not in the paper. The published memory of queries propagates points.

A reference encodes a point or a Gaussian as D numbers: the centre, [0, 1] over the map, possibly a
height, and for a Gaussian two sigmas and the angle theta before their activation. ``decode`` of the
reference space returns Gaussians in metres, and ``encode`` is its inverse.
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

COVARIANCES = ("points", "moved", "fused")  # values of ``covariance``, see `GaussianMemory`


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
        transformed = super().transform_references(head, references, past)
        if self.covariance == "points":
            # Zeros encode the sigmas and theta of the initial Gaussian of a query.
            initial_gaussians = torch.zeros_like(transformed[..., -3:])
            return torch.cat([transformed[..., :-3], initial_gaussians], dim=-1)
        space = require_gaussians(self, head).space
        # The variance grows linearly with time, so the standard deviation grows with its root. (B,)
        sqrt_seconds = past.seconds.sqrt()
        with torch.autocast(transformed.device.type, enabled=False):
            gaussians = move_gaussians(
                space.decode(references),
                motion=past.now_from_then,
                drift_m=self.noise_m * sqrt_seconds,
                drift_rad=self.noise_rad * sqrt_seconds,
            )
            # The heights are taken from the second argument.
            return space.encode(gaussians, transformed)

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
            fused = space.encode(gaussians, refined)  # with the heights of `refined`
        # `transform_references` has moved centres outside of the map to its border, away from the
        # element. These are not fused.
        distances = (transformed[..., :2] - 0.5).abs()  # distances from the middle of the map
        inside = distances.amax(-1, keepdim=True) < 0.5
        return torch.where(inside, fused, refined)
