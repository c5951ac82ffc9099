"""References of Gaussians, one per point, refined by decoder layers (GSMap Eqs. 1, 8)."""

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
    """References of Gaussians (GSMap Eq. 1).

    The D entries of a reference are the 2 or 3 coordinates of the point, which is the centre of the
    Gaussian, then the two sigmas before their activation, and theta. At the start of a training all
    Gaussians are equal, and layers do not change sigma and theta. Points may have a height, but
    Gaussians lie in the plane.

    Args:
        grid: Extent of the map.
        embed_dims: Channels C of the point states.
        num_layers: Number of decoder layers.
        mlp: Whether sigma and theta are predicted by MLPs, as the points are (GSMap Eq. 8), instead
            of one linear layer per decoder layer.
        coords: 2, or 3 for points with height.
        z_range: Lowest and highest z in metres, for points with height.
        points_per_state: Number of points n that one query initialises and one state refines.
        space: Settings of `GaussianSpace`, for example ``min_scale_m``.
    """

    space: GaussianSpace
    # Class that converts the predictions of the head to detections with scores.
    coder_class = GaussianCoder
    # Prefixes of weights that a checkpoint may lack: their initial values have no effect.
    neutral_keys: tuple[str, ...] = ("gaussian_init.", "gaussian_branches.")

    outputs = ("pts", "scales", "rotations")  # names of the fields that `decode` returns

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
        super().__init__(
            grid,
            embed_dims,
            num_layers=num_layers,
            coords=coords,
            z_range=z_range,
            points_per_state=points_per_state,
        )
        self.space = GaussianSpace(grid, **space)
        # Added to the predictions of each sample: their statistics count the sigmas at this bound.
        self.metainfo = {"min_scale_m": self.space.floor_m}
        entries = 3 * points_per_state  # two sigmas and theta for each point
        self.gaussian_init = nn.Linear(embed_dims, entries)
        dims = [embed_dims, embed_dims, embed_dims, entries] if mlp else [embed_dims, entries]
        self.gaussian_branches = nn.ModuleList(layers.mlp(*dims) for _ in range(num_layers))
        self.reset_gaussian_parts()

    def init_weights(self) -> None:
        """Initialise the networks of the points, and set the networks of sigma and theta to 0."""
        super().init_weights()
        self.reset_gaussian_parts()

    def reset_gaussian_parts(self) -> None:
        """Set weights so that all queries start with equal Gaussians and layers keep them.

        Only the last linear layer of each network is set to 0, so its output is 0.
        """
        constant_init(self.gaussian_init, 0.0)
        for branch in self.gaussian_branches:
            *_, last = branch.children()
            constant_init(last, 0.0)

    def start(self, query_pos: Tensor) -> Tensor:
        """Initial references of n points per query. (..., Q, C) -> (..., Q * n, D)"""
        # `by_point` splits the 3 n entries of a query into n points.
        shapes = self.by_point(self.gaussian_init(query_pos))  # sigma, theta (..., Q * n, 3)
        return torch.cat([super().start(query_pos), shapes], dim=-1)

    def refine(self, layer: int, point_states: Tensor, reference: Tensor) -> Tensor:
        """Refine the Gaussians after a layer (GSMap Eq. 8).

        Args:
            layer: Index of the layer.
            point_states: States, each of which refines n points. (..., Q, C)
            reference: References of the previous layer. (..., Q * n, D)

        Returns:
            The refined references. (..., Q * n, D)
        """
        points = super().refine(layer, point_states, reference[..., : self.coords])
        changes = self.by_point(self.gaussian_branches[layer](point_states))
        shapes = reference[..., self.coords :] + changes  # sigma, theta (..., Q * n, 3)
        return torch.cat([points, shapes], dim=-1)

    def transform_references(self, references: Tensor, motion: Tensor) -> Tensor:
        """Transform Gaussians of an earlier frame to the current frame, and rotate them.

        Args:
            references: References of the earlier frame. (B, ..., D)
            motion: Transform from the earlier to the current frame, in metres. (B, 4, 4)

        Returns:
            References of the current frame. (B, ..., D)
        """
        transformed = super().transform_references(references, motion)  # changes the points only
        # Angle of the motion in the plane. It is added to the angle of every Gaussian.
        rotation = torch.atan2(motion[:, 1, 0], motion[:, 0, 0]).to(transformed)
        while rotation.dim() < transformed.dim():
            rotation = rotation[..., None]
        theta = transformed[..., -1:] + rotation
        return torch.cat([transformed[..., :-1], theta], dim=-1)

    def errors(self, references: Tensor) -> Gaussians:
        """Gaussians that describe the errors of points, for parts that use uncertainties.

        They are equal to the rendered Gaussians. A subclass may predict separate ones.

        Args:
            references: References. (..., P, D)

        Returns:
            Centres (..., P, 2) and sigmas (..., P, 2) in metres, and angles in radians (..., P).
        """
        return self.space.decode(references)

    def decode(self, references: Tensor) -> dict[str, Tensor]:
        """Decode the points and Gaussians of a sample.

        Args:
            references: References. (N, P, D)

        Returns:
            ``pts`` in metres (N, P, coords), ``scales`` in metres (N, P, 2) and ``rotations`` in
            radians (N, P).
        """
        fields = super().decode(references)
        gaussians = self.errors(references)
        fields["scales"] = gaussians.scales
        fields["rotations"] = gaussians.rotations
        return fields

    def render(self, references: Tensor, grid: BEVGrid) -> Tensor:
        """Render the masks of elements (GSMap Eq. 6).

        Args:
            references: References. (..., P, D)
            grid: The raster: its extent in metres, and its H rows and W columns.

        Returns:
            Masks in [0, 1]. (..., H, W)
        """
        gaussians = self.space.decode(references)
        return render_gaussians(
            gaussians.means, gaussians.scales, rotations=gaussians.rotations, grid=grid
        )


def require_gaussians(part: Any, head: BuiltHead) -> GaussianReference:
    """Reference of a head with Gaussians.

    Args:
        part: Part of the model that needs Gaussians, for the message.
        head: The head.

    Raises:
        ValueError: If the head has points instead of Gaussians.
    """
    if isinstance(head.reference, GaussianReference):
        return head.reference
    raise InputError(
        f"{type(part).__name__} needs Gaussians, got {type(head.reference).__name__}: set "
        "reference=dict(type='GaussianReference'), or take GSMapHead."
    )
