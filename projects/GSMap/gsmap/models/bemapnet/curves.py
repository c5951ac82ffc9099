"""Points along predicted piecewise Bezier curves, and a loss of mask values (BeMapNet)."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from gsmap.structures.bezier import SAMPLES, bernstein

REACH_PX = 2  # pixels around a point of a curve, in all directions: a square of 5 x 5


def control_points(joints: Tensor, inner: Tensor) -> Tensor:
    """Convert logits to the control points of curves of k pieces of degree d.

    Args:
        joints: Logits of the joints, the ends of the pieces. (..., k + 1, 2)
        inner: Logits of the inner points, as offsets from the middle of their joints.
            (..., k, d - 1, 2)

    Returns:
        Control points in the order of the curve; joints are in [0, 1]. (..., k * d + 1, 2)
    """
    joints = joints.sigmoid()
    middles = (joints[..., :-1, :] + joints[..., 1:, :]) / 2
    inner = middles[..., None, :] + inner.sigmoid() - 0.5
    # Each piece contributes its first joint and its inner points. The last joint ends the curve.
    pieces = torch.cat([joints[..., :-1, None, :], inner], dim=-2)  # (..., k, d, 2)
    return torch.cat([pieces.flatten(-3, -2), joints[..., -1:, :]], dim=-2)


class Curve(nn.Module):
    """Sampling of 100 points of piecewise Bezier curves.

    Args:
        degree: Degree d of each piece.
        pieces: Largest number k of pieces of a curve.
        to_end: Whether the last point is the last joint. In the released code, curves of several
            pieces end before it.
    """

    # Weights of the control points at each sampled point. The first index is the number of pieces
    # of the curve less one. (k, 100, k * d + 1)
    weights: Tensor

    def __init__(self, degree: int, pieces: int, to_end: bool = False) -> None:
        super().__init__()
        # Weights of the control points at 100 samples of each piece, for curves of k pieces.
        piece_weights = torch.zeros(pieces, SAMPLES, pieces * degree + 1)
        basis = torch.from_numpy(bernstein(degree)).float()  # (100, d + 1)
        for index in range(pieces):
            first_control = index * degree
            piece_weights[index, :, first_control : first_control + degree + 1] = basis
        sample_weights = piece_weights.flatten(0, 1)  # (k * 100, k * d + 1)
        weights = []
        for number in range(1, pieces + 1):
            if to_end:
                last = number * SAMPLES - 1  # last sample of the last piece in use
                steps = torch.linspace(0, last, steps=SAMPLES).round().long()
            else:  # every number-th sample
                steps = torch.arange(SAMPLES) * number
            weights.append(sample_weights[steps])
        self.register_buffer("weights", torch.stack(weights), persistent=False)
        self.degree = degree

    def forward(self, controls: Tensor, pieces: Tensor) -> Tensor:
        """Sample the points of curves.

        Args:
            controls: Control points, unused ones at the end, whose weights are 0.
                (..., k * d + 1, 2)
            pieces: Index into ``weights``: number of pieces of each curve less one. (...,)

        Returns:
            Points along the curves. (..., 100, 2)
        """
        with torch.autocast(controls.device.type, enabled=False):  # half precision: up to 0.2 m off
            return self.weights[pieces] @ controls

    def control_mask(self, pieces: Tensor) -> Tensor:
        """Return True for the control points that curves of ``pieces + 1`` pieces use.

        (...,) -> (..., k * d + 1)
        """
        order = torch.arange(self.weights.shape[-1], device=pieces.device)
        return order <= (pieces[..., None] + 1) * self.degree


def neighbourhood(points: Tensor, size: Sequence[int]) -> Tensor:
    """Return the 25 raster positions around each point of curves.

    Args:
        points: Points in [0, 1] over the raster. (..., 100, 2)
        size: Rows H and columns W of the raster.

    Returns:
        Points in [0, 1]. (..., 2500, 2)
    """
    # The square is symmetric, so the sign of the offsets does not matter.
    steps = torch.arange(-REACH_PX, REACH_PX + 1, device=points.device)
    offsets = torch.cartesian_prod(steps / size[1], steps / size[0])  # (x, y): (25, 2)
    return (points[..., None, :] - offsets).clamp(0, 1).flatten(-3, -2)


def recovery_loss(values: Tensor) -> Tensor:
    """Compute the dice loss of mask values whose targets are all 1. (..., P) -> (...,)

    The values are read near the points of a true curve, where the mask should be foreground.
    """
    total = values.sum(dim=-1)
    return 1 - (2 * total + 1) / (total + values.shape[-1] + 1)
