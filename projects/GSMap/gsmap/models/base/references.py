"""Interfaces of references: the geometry that queries predict and decoder layers refine."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar

from torch import Tensor

from gsmap.structures.gaussians import GaussianSpace
from gsmap.structures.grid import BEVGrid


class Reference:
    """Base class of references that can be decoded to points.

    A reference has D entries: the coordinates of a point and, if points are Gaussians, also the
    parameters of the Gaussian.

    Attributes:
        outputs: Names of the fields that `decode` returns.
        metainfo: Entries that are added to the metainfo of all predictions.
    """

    outputs: tuple[str, ...] = ("pts",)
    metainfo: Mapping[str, Any] = MappingProxyType({})

    def decode(self, references: Tensor) -> dict[str, Tensor]:
        """Decode the references of a sample.

        Args:
            references: References of N elements with P points each. (N, P, D)

        Returns:
            ``pts`` in metres (N, P, 2 or 3), and the other fields of `outputs`. (N, ...)
        """
        raise NotImplementedError


class RefinedReference(Reference):
    """Base class of references that decoder layers refine.

    Each of Q queries has n references: n = 1 for the query of a point, n = P for the query of an
    instance.

    Attributes:
        coords: Number of coordinates of a point, which are the first entries of a reference: 2 or
            3.
        space: Encoding of Gaussians in references, None for references of points.
        coder_class: Class of the coder, which selects detections from the predictions. None means
            `MapCoder`.
    """

    coords: int
    space: GaussianSpace | None = None
    coder_class: ClassVar[type[Any] | None] = None

    def start(self, query_pos: Tensor) -> Tensor:
        """Initial references, from the positional queries. (..., Q, C) -> (..., Q * n, D)"""
        raise NotImplementedError

    def refine(self, layer: int, point_states: Tensor, reference: Tensor) -> Tensor:
        """Refine references after a layer.

        Args:
            layer: Index of the layer.
            point_states: States of the points. (..., Q, C)
            reference: References of the previous layer. (..., Q * n, D)

        Returns:
            The refined references. (..., Q * n, D)
        """
        raise NotImplementedError

    def metres(self, points: Tensor) -> Tensor:
        """Convert normalised points to metres. (..., coords) -> (..., coords)"""
        raise NotImplementedError

    def norm(self, points_m: Tensor) -> Tensor:
        """Normalise points in metres to [0, 1] over the map. (..., coords) -> (..., coords)"""
        raise NotImplementedError

    def transform_references(self, references: Tensor, motion: Tensor) -> Tensor:
        """Transform references of an earlier frame to the current frame.

        Args:
            references: References of the earlier frame. (B, ..., D)
            motion: Transform from the earlier to the current frame, in metres. (B, 4, 4)

        Returns:
            References of the current frame. (B, ..., D)
        """
        raise NotImplementedError

    def transform_points(self, points: Tensor, motion: Tensor) -> Tensor:
        """Transform normalised points of an earlier frame and clamp them to the current map.

        Args:
            points: Normalised points of the earlier frame. (B, ..., coords)
            motion: Transform from the earlier to the current frame, in metres. (B, 4, 4)

        Returns:
            Normalised points of the current frame. (B, ..., coords)
        """
        raise NotImplementedError

    def render(self, references: Tensor, grid: BEVGrid) -> Tensor:
        """Render the masks of elements whose references have an extent, such as Gaussians.

        Args:
            references: References. (..., P, D)
            grid: The raster.

        Returns:
            Masks in [0, 1]. (..., H, W)
        """
        raise NotImplementedError
