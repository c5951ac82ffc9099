"""How far off a predicted vertex may be: Gaussians of its error, and their loss."""

from typing import Any, cast

import torch
from mmdet3d.registry import MODELS
from mmengine.model import constant_init
from torch import Tensor, nn
from torch.distributions import Laplace, Normal

from gsmap.models.base import layers
from gsmap.models.base.losses import MapLoss
from gsmap.models.base.pairs import BuiltHead, MatchedPairs
from gsmap.models.base.parts import WEIGHT
from gsmap.models.gsmap.reference import GaussianReference, require_gaussians
from gsmap.structures.gaussians import (
    Gaussians,
    GaussianSpace,
    angles_of_line,
    extents_along_line,
    line_errors,
)


@MODELS.register_module()
class ErrorReference(GaussianReference):
    """Gaussians that are rendered, and beside them the sigma of each point's error.

    Rendering wants Gaussians as wide as a drawn line; an error is smaller near the vehicle and
    larger far from it. So the sigmas of the error, along and across the line, are two numbers of
    their own. They follow from a point's state and its Gaussian after each layer, without a
    gradient into both: what they learn changes no point. `decode` returns them as the Gaussians.

    Args:
        kwargs: Arguments of `GaussianReference`.
    """

    neutral_keys = (*GaussianReference.neutral_keys, "error_branches.")

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.error_space = GaussianSpace(
            self.grid, min_scale_m=0.05, max_scale_m=20.0, activation="exp"
        )
        self.metainfo = {"min_scale_m": self.error_space.floor_m}
        channels = self.gaussian_init.in_features
        self.error_branches = nn.ModuleList(
            layers.mlp(channels + 6, channels, 2) for _ in self.branches
        )
        self.reset_errors()

    def init_weights(self) -> None:
        """Initialise as Gaussians, with errors alike everywhere."""
        super().init_weights()
        self.reset_errors()

    def reset_errors(self) -> None:
        """Let every error start with the same sigma."""
        for branch in self.error_branches:
            constant_init(cast(nn.Sequential, branch)[-1], 0.0)

    def start(self, query_pos: Tensor) -> Tensor:
        """Return the Gaussians that the first layer starts from. (..., C) -> (..., D)"""
        start = super().start(query_pos)
        return self._with_errors(start, torch.zeros_like(start[..., :2]))

    def refine(self, layer: int, point_states: Tensor, reference: Tensor) -> Tensor:
        """Return the Gaussians after a layer, and the errors that it says. (..., D) -> (..., D)"""
        points, gaussians = reference[..., : self.coords], reference[..., -3:]
        refined = super().refine(layer, point_states, torch.cat([points, gaussians], -1))
        states = point_states.repeat_interleave(self.points_per_state, -2)
        seen = torch.cat([states, self.space.describe(refined)], -1).detach()
        return self._with_errors(refined, self.error_branches[layer](seen).to(refined))

    def _with_errors(self, reference: Tensor, errors: Tensor) -> Tensor:
        """Put the numbers of the errors between point and Gaussian."""
        return torch.cat([reference[..., :-3], errors, reference[..., -3:]], -1)

    def errors(self, references: Tensor) -> Gaussians:
        """Return the Gaussians of the points' errors, along the line. (..., P, D) -> (..., P)"""
        means = self.space.decode(references).means
        scales = self.error_space.scales(references[..., -5:-3])
        return Gaussians(means, scales, angles_of_line(means))


@MODELS.register_module()
class GaussianNLLLoss(MapLoss):
    """Negative log-likelihood of the points' errors across and along their lines.

    Both sigmas are those of the Gaussian in the line's own directions; the mean over points.

    Args:
        loss_weight: Weight of the loss.
        laplace: Take a Laplace distribution of the same variance in place of a normal one, which
            large errors pull less.
        detach_points: Learn the sigmas alone, without a gradient into the points.
        match_m: Pairs whose points lie farther from the line than this, in metres and on average,
            are no detections and are left out.
        flags: As in `MapLoss`.
    """

    name = "nll"

    def __init__(
        self,
        loss_weight: WEIGHT = 1.0,
        laplace: bool = False,
        detach_points: bool = True,
        match_m: float = 1.5,
        **flags: bool,
    ) -> None:
        super().__init__(loss_weight, **flags)
        self.laplace, self.detach_points, self.match_m = laplace, detach_points, match_m

    def check(self, head: BuiltHead) -> None:
        """Raise ValueError if the head has no Gaussians."""
        require_gaussians(self, head)

    def values(self, pairs: MatchedPairs) -> Tensor:
        """Return the values along and across the line. (M, 2)"""
        reference = cast(GaussianReference, pairs.predictions.reference)
        gaussians = reference.errors(pairs.pred_references)
        points = gaussians.means.detach() if self.detach_points else gaussians.means
        sigma = extents_along_line(gaussians._replace(means=points))  # (M, P, 2)
        errors = line_errors(points, pairs.gt_pts_m[..., :2])
        kind = Laplace(0, sigma / 2**0.5, False) if self.laplace else Normal(0, sigma, False)
        near = errors[..., 1].mean(-1) <= self.match_m
        return -kind.log_prob(errors).mean(1) * near[:, None]
