"""References: what decoder layers refine, from its first value to points in metres."""

from collections.abc import Sequence

import torch
from mmdet.models.layers import inverse_sigmoid
from mmdet3d.registry import MODELS
from mmengine.model import xavier_init
from torch import Tensor, nn

from gsmap.models.maptr.layers import mlp
from gsmap.structures.gaussians import GaussianSpace
from gsmap.structures.grid import BEVGrid
from gsmap.structures.tensors import at_least_float32, check_same_shape


def refine_reference(reference: Tensor, offsets: Tensor, coords: int = 2) -> Tensor:
    """Move a reference by predicted offsets.

    The point in (0, 1), the first ``coords`` entries, moves before its sigmoid; further entries
    (GSMap Eq. 1: sigma, theta before their activation) add up. The result is at least float32.
    ValueError if the shapes disagree. (..., D), (..., D) -> (..., D)
    """
    check_same_shape(reference=reference, offsets=offsets)
    reference, offsets = at_least_float32(reference), at_least_float32(offsets)
    points = inverse_sigmoid(reference[..., :coords], eps=1e-5) + offsets[..., :coords]
    return torch.cat([points.sigmoid(), reference[..., coords:] + offsets[..., coords:]], -1)


@MODELS.register_module()
class PointReference(nn.Module):
    """A point per query, [0, 1] over the map, refined by each decoder layer (MapTR).

    Args:
        grid: The map's extent.
        embed_dims: Channels C of the point states.
        num_layers: Decoder layers.
        coords: 2, or 3 for points with height.
        z_range: Lowest and highest z in metres, for points with height.

    Raises:
        ValueError: If ``coords`` is not 2 or 3, a height lacks its range, or that is empty.

    Attributes:
        space: How a reference stands for a Gaussian, None for points.
        outputs: What `decode` returns.
    """

    outputs: tuple[str, ...] = ("pts",)

    space: GaussianSpace | None = None

    def __init__(
        self,
        grid: BEVGrid,
        embed_dims: int = 256,
        num_layers: int = 6,
        coords: int = 2,
        z_range: Sequence[float] | None = None,
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
        self.initial = nn.Linear(embed_dims, coords)
        self.branches = nn.ModuleList(
            mlp(embed_dims, embed_dims, embed_dims, coords) for _ in range(num_layers)
        )
        self.metainfo: dict[str, float] = {}  # of all predictions

    def init_weights(self) -> None:
        """Spread the first points over the map."""
        xavier_init(self.initial, distribution="uniform", bias=0.0)

    def start(self, query_pos: Tensor) -> Tensor:
        """Return the reference that the first layer starts from. (..., C) -> (..., D)"""
        return at_least_float32(self.initial(query_pos)).sigmoid()

    def offsets(self, layer: int, point_states: Tensor) -> Tensor:
        """Return a layer's change of the reference, at least float32. (..., C) -> (..., D)"""
        return at_least_float32(self.branches[layer](point_states))

    def refine(self, layer: int, point_states: Tensor, reference: Tensor) -> Tensor:
        """Return the reference after a layer. (..., C), (..., D) -> (..., D)"""
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

    def decode(self, references: Tensor) -> dict[str, Tensor]:
        """Return what references (N, P, D) say in metres: ``pts`` (N, P, coords)."""
        return {"pts": self.metres(references[..., : self.coords])}

    def render(self, references: Tensor, grid: BEVGrid) -> Tensor:
        """Return rendered masks of what has an extent. (..., P, D) -> (..., H, W)

        Raises:
            TypeError: If it is points.
        """
        raise TypeError(f"{type(self).__name__} has no masks: set reference to GaussianReference.")
