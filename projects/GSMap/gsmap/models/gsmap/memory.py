"""Memory of Gaussians: transformation to the next frame, refinement, and fusion.

The memory of Gaussians is not in the GSMap paper. The memory of queries that other papers publish
(`QueryMemory`) propagates points.

A reference encodes a point or a Gaussian as D numbers. They are the centre, [0, 1] over the map,
and possibly a height. For a Gaussian, three numbers follow: its two sigmas before their activation,
and its angle theta from the direction of travel. ``decode`` of the reference space returns
Gaussians in metres, and ``encode`` is its inverse.
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
            query starts with the sigmas and the angle of the initial Gaussian of a new query.
            ``"moved"`` transforms the Gaussians with the motion of the vehicle and adds the noise
            to their covariance. ``"fused"`` also fuses each Gaussian that the decoder has refined
            with its transformed Gaussian of the previous frame (`fuse_gaussians`). Both belong to
            one point of a propagated query.
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
            # Gaussians have no height. The second argument supplies the heights, because the base
            # class has transformed them.
            return space.encode(gaussians, transformed)

    def fuse_references(self, refined: Tensor, transformed: Tensor, head: FlowHead) -> Tensor:
        """Fuse refined Gaussians with the transformed ones whose centres are on the map.

        With another ``covariance`` than ``"fused"``, the refined Gaussians are returned.

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
        # `transform_references` has clamped centres outside of the map to its border, away from
        # their element. These Gaussians are not fused. Their distance from the middle is 0.5.
        distances = (transformed[..., :2] - 0.5).abs()  # distances from the middle of the map
        inside = distances.amax(-1, keepdim=True) < 0.5
        return torch.where(inside, fused, refined)
