"""Qualities of matched Gaussians, for classification losses with a quality as target.

A quality in [0, 1] measures how well a prediction fits the ground truth that it is matched with.
Qualities are targets, so no gradient flows through them.
"""

from collections.abc import Sequence
from typing import cast

from mmdet3d.registry import MODELS
from torch import Tensor, nn

from gsmap.models.base.class_losses import Quality
from gsmap.models.base.pairs import BuiltHead, MatchedPairs
from gsmap.models.base.parts import PartConfig
from gsmap.models.gsmap.reference import GaussianReference, require_gaussians
from gsmap.ops.soft_iou import soft_iou
from gsmap.structures.gaussians import extents_along_line, line_errors


@MODELS.register_module()
class ErrorQuality(Quality):
    r"""Quality by the predicted uncertainty of points: the mean of :math:`\exp(-d^2 / 2 \sigma^2)`.

    The mean is over the points of an element. For each point, d is the error across the line, and
    sigma is the predicted standard deviation across the line, both in metres.

    Args:
        largest_m: Upper limit of sigma in metres, so that a large sigma cannot raise the quality of
            an inaccurate line.
    """

    def __init__(self, largest_m: float = 1.0) -> None:
        super().__init__()
        self.largest_m = largest_m

    def check(self, head: BuiltHead) -> None:
        """Raise ValueError if the head has no Gaussians."""
        require_gaussians(self, head)

    def forward(self, pairs: MatchedPairs) -> Tensor:
        """Quality of each matched pair. (M,)"""
        reference = cast(GaussianReference, pairs.predictions.reference)
        # `errors` decodes the predictions to Gaussians in metres. Their sigmas are the predicted
        # uncertainty of the points. (M, P)
        gaussians = reference.errors(pairs.pred_references.detach())
        sigmas = extents_along_line(gaussians)  # along, across (M, P, 2)
        errors = line_errors(gaussians.means, pairs.gt_pts_m[..., :2])  # along, across (M, P, 2)
        sigma_across = sigmas[..., 1].clamp(max=self.largest_m)
        exponents = -(errors[..., 1] / sigma_across).square() / 2  # (M, P)
        return exponents.exp().mean(-1)


@MODELS.register_module()
class MaskQuality(Quality):
    """Quality by the soft IoU of the rendered mask and the ground-truth mask.

    The metric AP_raster matches elements by the IoU of their masks, too.
    """

    def check(self, head: BuiltHead) -> None:
        """Raise ValueError if the head has no Gaussians."""
        require_gaussians(self, head)

    def forward(self, pairs: MatchedPairs) -> Tensor:
        """Quality of each matched pair. (M,)"""
        return soft_iou(pairs.pred_masks.detach(), pairs.gt_masks)


@MODELS.register_module()
class ProductQuality(Quality):
    """Product of several qualities.

    Args:
        qualities: Configs of the factors, one or more, such as ``dict(type="MaskQuality")``.
    """

    def __init__(self, qualities: Sequence[PartConfig]) -> None:
        super().__init__()
        self.qualities = nn.ModuleList(MODELS.build(quality) for quality in qualities)

    def check(self, head: BuiltHead) -> None:
        """Raise ValueError if the head lacks an input of a factor."""
        for quality in self.qualities:
            cast(Quality, quality).check(head)

    def forward(self, pairs: MatchedPairs) -> Tensor:
        """Quality of each matched pair. (M,)"""
        product = self.qualities[0](pairs)
        for quality in self.qualities[1:]:
            product = product * quality(pairs)
        return product
