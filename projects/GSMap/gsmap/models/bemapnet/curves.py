"""Piecewise Bezier curves as a head predicts them, and what they see of a mask."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from gsmap.structures.bezier import SAMPLES, bernstein

REACH_PX = 2  # pixels around a point of a curve, in all directions


def control_points(joints: Tensor, inner: Tensor) -> Tensor:
    """Return the control points that logits say: joints, and inner points from their middles.

    (..., k + 1, 2), (..., k, d - 1, 2) -> (..., k * d + 1, 2) in [0, 1]
    """
    joints = joints.sigmoid()
    middles = (joints[..., :-1, :] + joints[..., 1:, :]) / 2
    inner = middles[..., None, :] + inner.sigmoid() - 0.5
    pieces = torch.cat([joints[..., :-1, None, :], inner], -2).flatten(-3, -2)
    return torch.cat([pieces, joints[..., -1:, :]], -2)


class Curve(nn.Module):
    """100 points of curves of one degree and up to a number of pieces.

    Args:
        degree: Of each piece.
        pieces: Most pieces k of a curve.
        to_end: Whether the last point is the last joint; as released, curves of several pieces end
            before it.
    """

    weights: Tensor  # of the control points, by the number of pieces (k, 100, k * d + 1)

    def __init__(self, degree: int, pieces: int, to_end: bool = False) -> None:
        super().__init__()
        all_points = torch.zeros(pieces, SAMPLES, pieces * degree + 1)
        for i in range(pieces):
            part = torch.from_numpy(bernstein(degree)).float()
            all_points[i, :, i * degree : (i + 1) * degree + 1] = part
        chosen = []
        for number in range(1, pieces + 1):
            steps = torch.arange(SAMPLES) * number
            if to_end:
                steps = torch.linspace(0, number * SAMPLES - 1, SAMPLES).round().long()
            chosen.append(all_points.flatten(0, 1)[steps])
        self.register_buffer("weights", torch.stack(chosen), persistent=False)
        self.degree = degree

    def forward(self, controls: Tensor, pieces: Tensor) -> Tensor:
        """Return points of curves (..., P, 2) of ``pieces + 1`` pieces (...,). (..., 100, 2)"""
        return self.weights[pieces] @ controls

    def used(self, pieces: Tensor) -> Tensor:
        """Return which control points curves of numbers of pieces, less one, have. (..., P)"""
        order = torch.arange(self.weights.shape[-1], device=pieces.device)
        return order <= (pieces[..., None] + 1) * self.degree


def around(points: Tensor, size: Sequence[int]) -> Tensor:
    """Return points of the map around points of curves, in a raster of a size (H, W).

    (..., 100, 2) -> (..., 2500, 2)
    """
    steps = torch.arange(-REACH_PX, REACH_PX + 1, device=points.device)
    kernel = torch.cartesian_prod(steps / size[1], steps / size[0])
    return (points[..., None, :] - kernel).clamp(0, 1).flatten(-3, -2)


def missed(values: Tensor) -> Tensor:
    """Return the dice loss of values of masks that should all be 1. (..., P) -> (...,)"""
    return 1 - (2 * values.sum(-1) + 1) / (values.sum(-1) + values.shape[-1] + 1)
