"""Interfaces of references: geometry that predictions stand for, refined by decoder layers."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar

from torch import Tensor

from gsmap.structures.gaussians import GaussianSpace
from gsmap.structures.grid import BEVGrid


class Reference:
    """Decoding of references to points.

    Attributes:
        outputs: Names of the fields that `decode` returns.
        metainfo: Metadata of all predictions.
    """

    outputs: tuple[str, ...] = ("pts",)
    metainfo: Mapping[str, Any] = MappingProxyType({})

    def decode(self, references: Tensor) -> dict[str, Tensor]:
        """Return ``pts`` in metres (N, P, 2 or 3), and the other fields of `outputs`. (N, ...)"""
        raise NotImplementedError


class RefinedReference(Reference):
    """References that decoder layers refine, one per point query.

    Attributes:
        coords: Number of coordinates of a point, the first entries of a reference: 2 or 3.
        space: How a reference stands for a Gaussian, None for points.
        coder_class: Class of the coder of its detections, None for `MapCoder`.
    """

    coords: int
    space: GaussianSpace | None = None
    coder_class: ClassVar[type[Any] | None] = None

    def start(self, query_pos: Tensor) -> Tensor:
        """Return the reference that the first layer starts from. (..., Q, C) -> (..., Q * n, D)"""
        raise NotImplementedError

    def refine(self, layer: int, point_states: Tensor, reference: Tensor) -> Tensor:
        """Return the reference after a layer. (..., Q, C), (..., Q * n, D) -> (..., Q * n, D)"""
        raise NotImplementedError

    def metres(self, points: Tensor) -> Tensor:
        """Bring normalised points to metres. (..., coords) -> (..., coords)"""
        raise NotImplementedError

    def norm(self, points_m: Tensor) -> Tensor:
        """Bring points in metres to [0, 1] over the map. (..., coords) -> (..., coords)"""
        raise NotImplementedError

    def transform_references(self, references: Tensor, motion: Tensor) -> Tensor:
        """Return references of an earlier frame as they lie now. (B, ..., D) -> (B, ..., D)

        Args:
            references: References of the earlier frame. (B, ..., D)
            motion: Takes metres then to metres now. (B, 4, 4)
        """
        raise NotImplementedError

    def transform_points(self, points: Tensor, motion: Tensor) -> Tensor:
        """Return normalised points (B, ..., coords) after a motion (B, 4, 4), put onto the map."""
        raise NotImplementedError

    def render(self, references: Tensor, grid: BEVGrid) -> Tensor:
        """Return the masks of references with an extent. (..., P, D) -> (..., H, W)"""
        raise NotImplementedError
