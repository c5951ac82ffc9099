"""Point references: initial values, refinement by decoder layers, and points in metres."""

from collections.abc import Sequence

import torch
from mmdet3d.registry import MODELS
from mmengine.model import xavier_init
from torch import Tensor, nn

from gsmap.models.base.layers import init_matrices, mlp
from gsmap.models.base.references import RefinedReference
from gsmap.structures.grid import BEVGrid
from gsmap.structures.tensors import at_least_float32, check_same_shape, in_float32
from gsmap.utils.errors import InputError, InputTypeError

_EPS = 1e-5  # points closer to the border are moved to this distance before the logit


def refine_reference(reference: Tensor, offsets: Tensor, coords: int = 2) -> Tensor:
    """Add predicted offsets to a reference.

    The first ``coords`` entries are a point in (0, 1); its offset is added to its logit. Offsets of
    further entries (GSMap Eq. 1: sigma and theta before their activation) are added directly. The
    computation is at least in float32, because half precision is too coarse for coordinates.

    Args:
        reference: References. (..., D)
        offsets: Predicted offsets. (..., D)
        coords: Number of coordinates of the point.

    Returns:
        The refined references, at least float32. (..., D)

    Raises:
        ValueError: If the shapes disagree.
    """
    check_same_shape(reference=reference, offsets=offsets)
    reference = at_least_float32(reference)
    offsets = at_least_float32(offsets)
    inner = reference[..., :coords].clamp(_EPS, 1 - _EPS)
    points = (inner.logit() + offsets[..., :coords]).sigmoid()
    if reference.shape[-1] == coords:
        return points
    return torch.cat([points, reference[..., coords:] + offsets[..., coords:]], dim=-1)


@MODELS.register_module()
class PointReference(nn.Module, RefinedReference):
    """References of points, [0, 1] over the map, refined by each decoder layer (MapTR).

    A reference has D entries for each point. Here these are its coordinates; subclasses may add
    further entries.

    Args:
        grid: Extent of the map.
        embed_dims: Channels C of the point states.
        num_layers: Number of decoder layers.
        coords: Number of coordinates of a point: 2, or 3 with the height.
        z_range: Lowest and highest z in metres, for points with height.
        points_per_state: Number of points n of each query of the decoder. The initial points come
            from the positional query, and each layer refines them from the state of the query. The
            decoder has Q queries: one for each point, or with n > 1 one for n points of an
            instance. With n > 1, the networks are larger.

    Raises:
        ValueError: If ``coords`` is not 2 or 3, or 3 without a valid ``z_range``.
    """

    def __init__(
        self,
        grid: BEVGrid,
        embed_dims: int = 256,
        num_layers: int = 6,
        coords: int = 2,
        z_range: Sequence[float] | None = None,
        points_per_state: int = 1,
    ) -> None:
        super().__init__()
        has_height = coords == 3
        has_range = z_range is not None
        if coords not in (2, 3) or has_height != has_range:
            raise InputError(
                f"coords must be 2, or 3 with a z_range, got coords={coords}, z_range={z_range}."
            )
        if z_range is not None and not z_range[0] < z_range[1]:
            raise InputError(f"z_range must be (low, high) with low < high, got {z_range}.")
        self.grid = grid
        self.coords = coords
        self.z_range = None if z_range is None else (float(z_range[0]), float(z_range[1]))
        self.points_per_state = points_per_state
        entries = points_per_state * coords  # outputs of a network for each query
        self.initial: nn.Module = nn.Linear(embed_dims, entries)
        self.branches = nn.ModuleList()
        if points_per_state > 1:
            self.initial = mlp(embed_dims, embed_dims, entries)
        wide = 2 * embed_dims
        for _ in range(num_layers):
            if points_per_state > 1:
                branch = mlp(embed_dims, wide, wide, wide, entries)
            else:
                branch = mlp(embed_dims, embed_dims, embed_dims, entries)
            self.branches.append(branch)

    def by_point(self, entries: Tensor) -> Tensor:
        """Split the entries of each query into its points. (..., Q, n * D) -> (..., Q * n, D)

        The result is at least float32.
        """
        by_state = at_least_float32(entries).unflatten(-1, (self.points_per_state, -1))
        return by_state.flatten(-3, -2)

    def init_weights(self) -> None:
        """Initialise the network of the initial points from Xavier's uniform distribution."""
        if self.points_per_state == 1:
            xavier_init(self.initial, distribution="uniform", bias=0.0)
        else:
            init_matrices(self.initial)

    def start(self, query_pos: Tensor) -> Tensor:
        """Initial reference, from the positional queries. (..., Q, C) -> (..., Q * n, D)"""
        return self.by_point(in_float32(self.initial, query_pos)).sigmoid()

    def offsets(self, layer: int, point_states: Tensor) -> Tensor:
        """Offsets predicted by a layer.

        Args:
            layer: Index of the layer.
            point_states: States of the points. (..., Q, C)

        Returns:
            Offsets for `refine_reference`. (..., Q * n, D)
        """
        return self.by_point(in_float32(self.branches[layer], point_states))

    def refine(self, layer: int, point_states: Tensor, reference: Tensor) -> Tensor:
        """Refine the reference after a layer.

        Args:
            layer: Index of the layer.
            point_states: States of the points. (..., Q, C)
            reference: Reference of the previous layer. (..., Q * n, D)

        Returns:
            The refined reference. (..., Q * n, D)
        """
        offsets = self.offsets(layer, point_states)
        return refine_reference(reference, offsets, coords=self.coords)

    def metres(self, points: Tensor) -> Tensor:
        """Convert normalised points to metres. (..., coords) -> (..., coords)"""
        points = self.grid.metres_from_norm(points)
        if self.z_range is None:
            return points
        low, high = self.z_range
        return torch.cat([points[..., :2], low + (high - low) * points[..., 2:]], dim=-1)

    def norm(self, points_m: Tensor) -> Tensor:
        """Normalise points in metres to [0, 1]; the inverse of :meth:`metres`.

        A height outside ``z_range`` is clamped to it.

        Args:
            points_m: Points in metres; further coordinates are ignored. (..., >= coords)

        Returns:
            Normalised points. (..., coords)

        Raises:
            ValueError: If the points have no height but the reference has.
        """
        if points_m.shape[-1] < self.coords:
            raise InputError(
                f"the model's points have {self.coords} coordinates, the targets' "
                f"{points_m.shape[-1]}: set dim={self.coords} in the data set."
            )
        points = self.grid.norm_from_metres(points_m[..., : self.coords])
        if self.z_range is None:
            return points
        low, high = self.z_range
        height = (points[..., 2:].clamp(low, high) - low) / (high - low)
        return torch.cat([points[..., :2], height], dim=-1)

    def transform_references(self, references: Tensor, motion: Tensor) -> Tensor:
        """Transform references of an earlier frame to the current frame.

        Args:
            references: References of the earlier frame. (B, ..., D)
            motion: Transform from the earlier to the current frame, in metres. (B, 4, 4)

        Returns:
            References of the current frame. (B, ..., D)
        """
        points = self.transform_points(references[..., : self.coords], motion)
        return torch.cat([points, references[..., self.coords :]], dim=-1)

    def transform_points(self, points: Tensor, motion: Tensor) -> Tensor:
        """Transform normalised points and clamp them to the map.

        The computation has the precision of ``motion``.

        Args:
            points: Normalised points. (B, ..., coords)
            motion: Transform in metres. (B, 4, 4)

        Returns:
            Normalised points. (B, ..., coords)
        """
        points_m = self.metres(points.to(motion))
        # With two coordinates only the motion in the plane applies. Points are rows, so they are
        # multiplied by the transposed rotation from the right.
        rotation = motion[:, : self.coords, : self.coords].transpose(1, 2)
        translation = motion[:, None, : self.coords, 3]
        transformed_m = points_m.flatten(1, -2) @ rotation + translation
        return self.norm(transformed_m).clamp(0.0, 1.0).view_as(points).to(points)

    def decode(self, references: Tensor) -> dict[str, Tensor]:
        """Decode the points of a sample.

        Args:
            references: References. (N, P, D)

        Returns:
            ``pts`` in metres. (N, P, coords)
        """
        return {"pts": self.metres(references[..., : self.coords])}

    def render(self, references: Tensor, grid: BEVGrid) -> Tensor:
        """Raise TypeError, because points have no extent to render.

        Args:
            references: References. (..., P, D)
            grid: The raster.

        Raises:
            TypeError: Always.
        """
        raise InputTypeError(
            f"{type(self).__name__} has no masks: set reference to GaussianReference."
        )
