"""References: what decoder layers refine, from its first value to points in metres."""

from collections.abc import Sequence

import torch
from mmdet3d.registry import MODELS
from mmengine.model import xavier_init
from torch import Tensor, nn

from gsmap.models.base.layers import init_matrices, mlp
from gsmap.models.base.references import RefinedReference
from gsmap.structures.grid import BEVGrid
from gsmap.structures.tensors import at_least_float32, check_same_shape, in_float32

_EPS = 1e-5  # a point closer to the border moves as one at this distance


def refine_reference(reference: Tensor, offsets: Tensor, coords: int = 2) -> Tensor:
    """Move a reference by predicted offsets.

    The point in (0, 1), the first ``coords`` entries, moves before its sigmoid; further entries
    (GSMap Eq. 1: sigma, theta before their activation) add up. The result is at least float32.
    ValueError if the shapes disagree. (..., D), (..., D) -> (..., D)
    """
    check_same_shape(reference=reference, offsets=offsets)
    reference, offsets = at_least_float32(reference), at_least_float32(offsets)
    inner = reference[..., :coords].clamp(_EPS, 1 - _EPS)
    points = (inner.logit() + offsets[..., :coords]).sigmoid()
    if reference.shape[-1] == coords:
        return points
    return torch.cat([points, reference[..., coords:] + offsets[..., coords:]], -1)


@MODELS.register_module()
class PointReference(nn.Module, RefinedReference):
    """A point per query, [0, 1] over the map, refined by each decoder layer (MapTR).

    Args:
        grid: The map's extent.
        embed_dims: Channels C of the point states.
        num_layers: Decoder layers.
        coords: 2, or 3 for points with height.
        z_range: Lowest and highest z in metres, for points with height.
        points_per_state: Points that start from one query and move by one state. More than one have
            larger networks, as in MapQR.

    Raises:
        ValueError: If ``coords`` is not 2 or 3, a height lacks its range, or that is empty.
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
        if coords not in (2, 3) or (coords == 3) != (z_range is not None):
            raise ValueError(
                f"coords must be 2, or 3 with a z_range, got coords={coords}, z_range={z_range}."
            )
        if z_range is not None and not z_range[0] < z_range[1]:
            raise ValueError(f"z_range must be (low, high) with low < high, got {z_range}.")
        self.grid, self.coords = grid, coords
        self.z_range = None if z_range is None else (float(z_range[0]), float(z_range[1]))
        self.points_per_state = points_per_state
        entries = points_per_state * coords
        self.initial: nn.Module = nn.Linear(embed_dims, entries)
        hidden = [embed_dims] * 2
        if points_per_state > 1:
            self.initial = mlp(embed_dims, embed_dims, entries)
            hidden = [2 * embed_dims] * 3
        self.branches = nn.ModuleList(mlp(embed_dims, *hidden, entries) for _ in range(num_layers))

    def by_point(self, entries: Tensor) -> Tensor:
        """Sort entries of states by point, at least float32. (..., Q, n * D) -> (..., Q * n, D)"""
        by_state = at_least_float32(entries).unflatten(-1, (self.points_per_state, -1))
        return by_state.flatten(-3, -2)

    def init_weights(self) -> None:
        """Spread the first points over the map."""
        if self.points_per_state == 1:
            xavier_init(self.initial, distribution="uniform", bias=0.0)
        else:
            init_matrices(self.initial)

    def start(self, query_pos: Tensor) -> Tensor:
        """Return the reference that the first layer starts from. (..., Q, C) -> (..., Q * n, D)"""
        return self.by_point(in_float32(self.initial, query_pos)).sigmoid()

    def offsets(self, layer: int, point_states: Tensor) -> Tensor:
        """Return a layer's change of the reference. (..., Q, C) -> (..., Q * n, D)"""
        return self.by_point(in_float32(self.branches[layer], point_states))

    def refine(self, layer: int, point_states: Tensor, reference: Tensor) -> Tensor:
        """Return the reference after a layer. (..., Q, C), (..., Q * n, D) -> (..., Q * n, D)"""
        return refine_reference(reference, self.offsets(layer, point_states), self.coords)

    def metres(self, points: Tensor) -> Tensor:
        """Bring normalised points to metres. (..., coords) -> (..., coords)"""
        points = self.grid.metres_from_norm(points)
        if self.z_range is None:
            return points
        low, high = self.z_range
        return torch.cat([points[..., :2], low + (high - low) * points[..., 2:]], -1)

    def norm(self, points_m: Tensor) -> Tensor:
        """Bring points in metres to [0, 1]; the inverse of :meth:`metres`.

        A height outside ``z_range`` becomes the nearest one in it, as in MapTRv2. ValueError if the
        points have no height and the reference has.
        """
        if points_m.shape[-1] < self.coords:
            raise ValueError(
                f"the model's points have {self.coords} coordinates, the targets' "
                f"{points_m.shape[-1]}: set dim={self.coords} in the data set."
            )
        points = self.grid.norm_from_metres(points_m[..., : self.coords])
        if self.z_range is None:
            return points
        low, high = self.z_range
        height = (points[..., 2:].clamp(low, high) - low) / (high - low)
        return torch.cat([points[..., :2], height], -1)

    def moved(self, references: Tensor, motion: Tensor) -> Tensor:
        """Return references of an earlier frame as they lie now. (B, ..., D) -> (B, ..., D)

        The motion (B, 4, 4) takes metres then to metres now.
        """
        points = self.moved_points(references[..., : self.coords], motion)
        return torch.cat([points, references[..., self.coords :]], -1)

    def moved_points(self, points: Tensor, motion: Tensor) -> Tensor:
        """Return normalised points (B, ..., coords) after a motion (B, 4, 4), put onto the map.

        It is computed in the motion's precision.
        """
        metres = self.metres(points.to(motion))
        turn = motion[:, : self.coords, : self.coords].transpose(1, 2)  # without z: on the ground
        moved = metres.flatten(1, -2) @ turn + motion[:, None, : self.coords, 3]
        return self.norm(moved).clamp(0.0, 1.0).view_as(points).to(points)

    def decode(self, references: Tensor) -> dict[str, Tensor]:
        """Return what references (N, P, D) say in metres: ``pts`` (N, P, coords)."""
        return {"pts": self.metres(references[..., : self.coords])}

    def render(self, references: Tensor, grid: BEVGrid) -> Tensor:
        """Return rendered masks of what has an extent. (..., P, D) -> (..., H, W)

        Raises:
            TypeError: If it is points.
        """
        raise TypeError(f"{type(self).__name__} has no masks: set reference to GaussianReference.")
