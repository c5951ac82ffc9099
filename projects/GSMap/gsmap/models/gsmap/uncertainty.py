"""Uncertainty of predicted points: Gaussians of the errors, and a loss that trains them."""

from typing import Any, cast

import torch
from mmdet3d.registry import MODELS
from mmengine.model import constant_init
from torch import Tensor, nn
from torch.distributions import Laplace, Normal

from gsmap.models.base import layers
from gsmap.models.base.losses import MapLoss
from gsmap.models.base.pairs import BuiltHead, MatchedPairs
from gsmap.models.base.parts import WeightConfig
from gsmap.models.gsmap.reference import GaussianReference, require_gaussians
from gsmap.structures.gaussians import (
    Gaussians,
    GaussianSpace,
    angles_of_line,
    extents_along_line,
    line_errors,
)
from gsmap.structures.grid import BEVGrid

GAUSSIAN_FEATURES = 6  # number of features that `GaussianSpace.describe` returns


@MODELS.register_module()
class ErrorReference(GaussianReference):
    """Rendered Gaussians, with separate sigmas for the errors of the points.

    Rendered Gaussians have the width of a drawn line everywhere, whereas errors grow with the
    distance to the vehicle. A reference therefore has two further entries: sigmas of the error
    along and across the line, before their activation. Its D entries are the 2 or 3 coordinates of
    the point, the 2 sigmas of the error, and the 2 sigmas and the angle of the rendered Gaussian.

    After each layer, a network predicts the sigmas of the error from the state and the Gaussian of
    the point. These inputs are detached, so that the loss of the sigmas does not change the points.
    `errors` returns the Gaussians of the errors. The inherited `decode` calls it, so that
    predictions have these Gaussians, too.

    Args:
        grid: Extent of the map.
        embed_dims: Channels C of the point states.
        kwargs: Further arguments of `GaussianReference`.
    """

    # A checkpoint may lack the weights with these prefixes (`AddsWeights`).
    neutral_keys = (*GaussianReference.neutral_keys, "error_branches.")

    def __init__(self, grid: BEVGrid, embed_dims: int = 256, **kwargs: Any) -> None:
        super().__init__(grid, embed_dims, **kwargs)
        self.error_space = GaussianSpace(grid, min_scale_m=0.05, max_scale_m=20.0, activation="exp")
        # The metainfo of predictions contains the smallest sigma, here 0.05 m, so that an
        # evaluation can count the Gaussians whose sigmas are close to it.
        self.metainfo = {"min_scale_m": self.error_space.floor_m}
        # `branches` of the base class has one network for each decoder layer.
        self.error_branches = nn.ModuleList(
            layers.mlp(embed_dims + GAUSSIAN_FEATURES, embed_dims, 2) for _ in self.branches
        )
        self.reset_errors()

    def init_weights(self) -> None:
        """Initialise the Gaussians, and set the sigmas of all errors to one value."""
        super().init_weights()
        self.reset_errors()

    def reset_errors(self) -> None:
        """Set the sigmas of all errors to one value, independent of the input."""
        for branch in self.error_branches:
            # The last linear layer then returns 0 for any input.
            constant_init(cast(nn.Sequential, branch)[-1], 0.0)

    def start(self, query_pos: Tensor) -> Tensor:
        """Initial references of n points per query. (..., Q, C) -> (..., Q * n, D)"""
        # Zeros stand for the initial sigma of `error_space`.
        start = super().start(query_pos)
        return self._with_errors(start, torch.zeros_like(start[..., :2]))

    def refine(self, layer: int, point_states: Tensor, reference: Tensor) -> Tensor:
        """Refine the Gaussians after a layer, and predict the sigmas of the errors.

        Args:
            layer: Index of the layer.
            point_states: States, each of which refines n points. (..., Q, C)
            reference: References of the previous layer. (..., Q * n, D)

        Returns:
            The refined references. (..., Q * n, D)
        """
        points = reference[..., : self.coords]  # 2 or 3 coordinates
        gaussians = reference[..., -3:]  # sigmas and angle of the rendered Gaussian
        without_errors = torch.cat([points, gaussians], dim=-1)  # (..., Q * n, D - 2)
        refined = super().refine(layer, point_states, reference=without_errors)
        # One copy of the state for each of its n points.
        states = point_states.repeat_interleave(self.points_per_state, dim=-2)
        inputs = torch.cat([states, self.space.describe(refined)], dim=-1).detach()
        errors = self.error_branches[layer](inputs)  # (..., Q * n, 2)
        return self._with_errors(refined, errors.to(refined))

    def _with_errors(self, reference: Tensor, errors: Tensor) -> Tensor:
        """Insert sigmas of the error before the Gaussian. (..., D - 2), (..., 2) -> (..., D)"""
        return torch.cat([reference[..., :-3], errors, reference[..., -3:]], dim=-1)

    def errors(self, references: Tensor) -> Gaussians:
        """Gaussians of the errors of points, oriented along the line.

        Args:
            references: References of the decoder. (..., P, D)

        Returns:
            Points as centres, sigmas in metres, and angles of the line in radians. (..., P)
        """
        # The means depend only on the first two entries, x and y. The sigmas of the error follow
        # them and need not be removed.
        means = self.space.decode(references).means
        scales = self.error_space.scales(references[..., -5:-3])  # the sigmas of the error
        return Gaussians(means, scales, angles_of_line(means))


@MODELS.register_module()
class GaussianNLLLoss(MapLoss):
    """Negative log-likelihood of the errors of points along and across their lines.

    The sigmas are the standard deviations of the Gaussian along and across the line. The loss is
    averaged over the points.

    Args:
        loss_weight: Weight of the loss, or a weight for each class.
        laplace: Use a Laplace distribution of equal variance instead of a normal one. It gives
            large errors less influence on the loss.
        detach_points: Stop the gradient in the points, so that only the sigmas are trained.
        match_m: Largest mean distance of the points from the true line, in metres. The loss of
            pairs farther apart is 0, because they do not count as detections.
        flags: Flags of `MapLoss`.
    """

    name = "nll"

    def __init__(
        self,
        loss_weight: WeightConfig = 1.0,
        laplace: bool = False,
        detach_points: bool = True,
        match_m: float = 1.5,
        **flags: bool,
    ) -> None:
        super().__init__(loss_weight=loss_weight, **flags)
        self.laplace = laplace
        self.detach_points = detach_points
        self.match_m = match_m

    def check(self, head: BuiltHead) -> None:
        """Raise ValueError if the head has no Gaussians."""
        require_gaussians(self, head)

    def values(self, pairs: MatchedPairs) -> Tensor:
        """Negative log-likelihoods along and across the line, averaged over the points. (M, 2)"""
        reference = cast(GaussianReference, pairs.predictions.reference)
        # One Gaussian per point of the M pairs, centred on the predicted point. (M, P)
        gaussians = reference.errors(pairs.pred_references)
        points = gaussians.means.detach() if self.detach_points else gaussians.means
        # Standard deviations and absolute errors; the columns are (along, across). (M, P, 2) each
        sigma = extents_along_line(gaussians._replace(means=points))
        errors = line_errors(points, pairs.gt_pts_m[..., :2])
        # Torch's validation of arguments would wait for the GPU.
        distribution: Laplace | Normal
        if self.laplace:
            # A Laplace distribution of scale b has the standard deviation sqrt(2) b.
            distribution = Laplace(0, sigma / 2**0.5, validate_args=False)
        else:
            distribution = Normal(0, sigma, validate_args=False)
        errors_across = errors[..., 1]
        is_detection = errors_across.mean(-1) <= self.match_m  # (M,)
        return -distribution.log_prob(errors).mean(1) * is_detection[:, None]
