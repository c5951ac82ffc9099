"""2D Gaussians as parts of map elements, and how a network's numbers become Gaussians."""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from gsmap.structures.grid import BEVGrid
from gsmap.structures.tensors import at_least_float32, constant, kept
from gsmap.utils.errors import InputError

ACTIVATIONS = ("sigmoid", "softplus", "exp")
_ROUND = 1e-6  # relative difference of both variances, below which a Gaussian has no direction
_MARGIN = 1e-4  # of the range of sigma, kept off its ends where no number stands for it
_TINY = 1e-12  # square metres; a shorter segment has no direction
AT_FLOOR = 1.1  # a Gaussian is at its floor if both sigmas are below this multiple of it


class Gaussians(NamedTuple):
    """Ordered 2D Gaussians G = (mu, sigma, theta) (GSMap Eq. 1).

    Centres mu in metres (..., 2), standard deviations sigma along their own axes in metres (..., 2)
    and the angle theta of the first axis from +x in radians, anticlockwise (...).
    """

    means: Tensor
    scales: Tensor
    rotations: Tensor


@dataclass(frozen=True)
class GaussianSpace:
    r"""How a decoder's reference stands for a Gaussian.

    Its first entries are the centre, [0, 1] over the map; the last three stand for sigma (2) and
    theta (1), all three zero for the Gaussian that a query starts with. That one lies along the
    direction of travel: a round one has no direction, and so no gradient in theta.

    Args:
        grid: The map's extent and direction of travel; its raster is not used.
        min_scale_m: Smallest sigma in metres. Half a pixel of the training raster: a smaller
            Gaussian falls between pixels and gets no gradient.
        max_scale_m: Largest sigma in metres.
        init_scales_m: Sigma of the Gaussian that a query starts with, along and across the
            direction of travel, in metres.
        activation: How a number s becomes sigma, with s_0 so that zero gives the first one:
            ``"sigmoid"``: min + (max - min) sigmoid(s + s_0); ``"softplus"``: min + softplus(s +
            s_0); ``"exp"``: min + exp(s + s_0), the last two cut off at the largest.
        literal_covariance: Take S = diag(sigma^2) as GSMap's Eq. 3 prints it, so that the standard
            deviations are the squares of sigma.

    Raises:
        ValueError: If not min < init < max for both axes, or ``activation`` is unknown.
    """

    grid: BEVGrid
    min_scale_m: float = 0.15
    max_scale_m: float = 5.0
    init_scales_m: tuple[float, float] = (1.0, 0.4)
    activation: str = "sigmoid"
    literal_covariance: bool = False
    _start: tuple[float, ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "init_scales_m", tuple(float(s) for s in self.init_scales_m))
        if not all(0 < self.min_scale_m < s < self.max_scale_m for s in self.init_scales_m):
            raise InputError(
                "0 < min_scale_m < init_scales_m < max_scale_m must hold, got "
                f"{self.min_scale_m}, {self.init_scales_m}, {self.max_scale_m}."
            )
        if self.activation not in ACTIVATIONS:
            raise InputError(f"activation must be one of {ACTIVATIONS}, got {self.activation!r}.")
        first = torch.tensor(self.init_scales_m, dtype=torch.float64)
        object.__setattr__(self, "_start", tuple(self._before_activation(first).tolist()))

    @property
    def floor_m(self) -> float:
        """Smallest standard deviation in metres."""
        return self.min_scale_m**2 if self.literal_covariance else self.min_scale_m

    @property
    def heading_rad(self) -> float:
        """Angle of the direction of travel from +x in radians."""
        return 0.0 if self.grid.forward == "x" else math.pi / 2

    def decode(self, reference: Tensor) -> Gaussians:
        """Return the Gaussians that a reference stands for, differentiable, in float32 at least.

        Its entries are the centre in [0, 1] (and perhaps a height), then sigma and theta before
        their activation; ValueError if there are fewer than five. (..., 5 or more) -> (...)
        """
        if reference.shape[-1] < 5:
            raise InputError(
                f"reference must have shape (..., 5) or more, got {tuple(reference.shape)}."
            )
        reference = at_least_float32(reference)
        means = self.grid.metres_from_norm(reference[..., :2])
        scales = self.scales(reference[..., -3:-1])
        if self.literal_covariance:
            scales = scales.square()  # GSMap Eq. 3 as printed
        return Gaussians(means, scales, reference[..., -1] + self.heading_rad)

    def scales(self, raw: Tensor) -> Tensor:
        """Activate sigma: zero gives ``init_scales_m``. (..., 2) -> (..., 2) metres"""
        shifted = raw + constant(raw, self._start)
        if self.activation == "sigmoid":
            span = constant(raw, self.max_scale_m - self.min_scale_m)
            return torch.addcmul(constant(raw, self.min_scale_m), shifted.sigmoid(), span)
        above = F.softplus(shifted) if self.activation == "softplus" else shifted.exp()
        return (self.min_scale_m + above).clamp(max=self.max_scale_m)

    def _before_activation(self, scales: Tensor) -> Tensor:
        """Return s + s_0 of sigma in metres, between the smallest and the largest. (...)"""
        above = scales - self.min_scale_m
        if self.activation == "sigmoid":
            return (above / (self.max_scale_m - scales)).log()
        return (above.expm1() if self.activation == "softplus" else above).log()

    def encode(self, gaussians: Gaussians, like: Tensor) -> Tensor:
        """Return references that stand for Gaussians: the inverse of `decode`.

        What no reference can say is made the nearest one: a centre off the map, a sigma beyond its
        range.

        Args:
            gaussians: Their (...).
            like: References whose heights, if there are any, are taken over. (..., D)

        Returns:
            The references, differentiable. (..., D)
        """
        centres = self.grid.norm_from_metres(gaussians.means).clamp(0.0, 1.0)
        scales = gaussians.scales.sqrt() if self.literal_covariance else gaussians.scales
        margin = _MARGIN * (self.max_scale_m - self.min_scale_m)
        scales = scales.clamp(self.min_scale_m + margin, self.max_scale_m - margin)
        raw = self._before_activation(scales) - constant(scales, self._start)
        theta = gaussians.rotations[..., None] - self.heading_rad
        return torch.cat([centres, like[..., 2:-3], raw, theta], -1)

    def frames(
        self,
        reference: Tensor,
        invariant: bool = False,
        cell_m: tuple[float, float] = (1.0, 1.0),
    ) -> Tensor:
        r"""Matrices that bring an offset into each Gaussian's own frame.

        With the stretch :math:`D = \mathrm{diag}(\sigma / \sigma_{init})` and the direction of
        travel :math:`\theta_0`, the matrix is :math:`R(\theta) D R(\theta_0)^T`. The invariant one,
        :math:`R(\theta) D R(\theta)^T`, is equal for theta and theta + pi, which are one Gaussian.
        Both are exactly the identity for the Gaussian that a query starts with.

        Each operation is a launch on a GPU, six times a frame, so constants are multiplied
        beforehand.

        Args:
            reference: Entries of the decoder's references. (..., D)
            invariant: Whether to return the invariant matrices.
            cell_m: Size of a cell along x and y in metres, if offsets are in cells.

        Returns:
            Matrices that multiply offsets (x, y) from the left. (..., 2, 2)
        """
        reference = at_least_float32(reference)
        scales = self.scales(reference[..., -3:-1])
        if self.literal_covariance:
            scales = scales.square()
        # computed as the scales are, so that their quotient is exactly one
        start = kept(scales, (self, "start", scales.dtype), lambda: self._first_scales(scales))
        stretch = scales / start
        theta = reference[..., -1:]
        ratio = (cell_m[0] / cell_m[1], cell_m[1] / cell_m[0])
        along_x = self.grid.forward == "x"
        if invariant:
            cos, sin = self._double_angle(theta).split(1, dim=-1)
            middle = (stretch[..., :1] + stretch[..., 1:]) / 2
            half = (stretch[..., :1] - stretch[..., 1:]) / 2
            aside = half * sin
            rows = [middle + half * cos, aside * ratio[1], aside * ratio[0], middle - half * cos]
            return torch.cat(rows, -1).unflatten(-1, (2, 2))
        # the angle from the direction of travel; the products of both stretches with its cosine
        # and sine are the entries of R D, which constants turn and scale
        turn = _cos_and_sin(theta, 1.0, 0.0)
        products = (stretch[..., :, None] * turn[..., None, :]).flatten(-2)
        entries = (
            [(1, 0, 0, 0), (0, 0, ratio[0], 0), (0, 0, 0, 1), (0, -ratio[1], 0, 0)]
            if along_x
            else [(0, 0, 0, 1), (0, -ratio[1], 0, 0), (1, 0, 0, 0), (0, 0, ratio[0], 0)]
        )
        return (products @ constant(products, entries)).unflatten(-1, (2, 2))

    def _first_scales(self, like: Tensor) -> Tensor:
        """Standard deviations of the Gaussian that a query starts with. (2,)"""
        start = self.scales(like.new_zeros(2))
        return start.square() if self.literal_covariance else start

    def _double_angle(self, theta: Tensor) -> Tensor:
        """Cosine and sine of twice the angle from +x. (..., 1) -> (..., 2)"""
        return _cos_and_sin(theta, 2.0, 2 * self.heading_rad)

    def describe(self, reference: Tensor) -> Tensor:
        """Return numbers of unit size that describe the Gaussians. (..., 5 or more) -> (..., 6)

        They are mu in [-1, 1], sigma before its activation, cos and sin of 2 theta, as a Gaussian
        turned by half a circle is the same.
        """
        centre = torch.add(constant(reference, -1.0), reference[..., :2], alpha=2)
        angle = self._double_angle(reference[..., -1:])
        return torch.cat([centre, reference[..., -3:-1], angle], -1)


def _cos_and_sin(angle: Tensor, factor: float, shift_rad: float) -> Tensor:
    """Cosine and sine of ``factor * angle + shift_rad`` by two operations. (..., 1) -> (..., 2)"""
    shifts = constant(angle, (shift_rad + math.pi / 2, shift_rad))
    return torch.addcmul(shifts, angle, constant(angle, factor)).sin()


def covariances(gaussians: Gaussians) -> Tensor:
    """Return the covariances (GSMap Eq. 2) in square metres. (...) -> (..., 2, 2)"""
    axes = _rotations(gaussians.rotations) * gaussians.scales[..., None, :]
    return axes @ axes.transpose(-1, -2)


def with_covariances(means: Tensor, covariances: Tensor, near: Tensor) -> Gaussians:
    """Return Gaussians of given covariances, differentiable also where they are round.

    Args:
        means: Their centres in metres. (..., 2)
        covariances: Symmetric, positive definite, in square metres. (..., 2, 2)
        near: Angle that a first axis is close to, within an eighth of a turn, in radians: half
            turns and the order of the axes are free otherwise. (...)
    """
    near = near.detach()  # the Gaussian itself does not depend on it
    frame = _rotations(near)
    inside = frame.transpose(-1, -2) @ covariances @ frame
    middle = (inside[..., 0, 0] + inside[..., 1, 1]) / 2
    half = (inside[..., 0, 0] - inside[..., 1, 1]) / 2
    cross = (inside[..., 0, 1] + inside[..., 1, 0]) / 2
    is_round = half.square() + cross.square() <= (_ROUND * middle).square()
    half = torch.where(is_round, torch.ones_like(half), half)  # neither root nor angle has a
    cross = torch.where(is_round, torch.zeros_like(cross), cross)  # gradient at zero
    sign = torch.where(half < 0, -1.0, 1.0)
    angle = torch.atan2(sign * cross, half.abs()) / 2
    radius = torch.where(is_round, 0.0, sign * (half.square() + cross.square()).sqrt())
    scales = torch.stack([middle + radius, middle - radius], -1).sqrt()
    return Gaussians(means, scales, near + angle)


def moved_gaussians(
    gaussians: Gaussians, motion: Tensor, drift_m: Tensor, drift_rad: Tensor
) -> Gaussians:
    r"""Return Gaussians as another frame sees them, less certain by the noise of the motion.

    With the motion's rotation R and its translation, the centre becomes :math:`R \mu + t` and the
    covariance :math:`R \Sigma R^T + \sigma_t^2 I + \sigma_r^2 p p^T`, p being the new centre turned
    by a quarter: a wrong angle moves what is far off further.

    Args:
        gaussians: Their (B, ...).
        motion: From metres of their frame to those of the other. (B, 4, 4)
        drift_m: Standard deviation of the motion's translation along each axis, in metres. (B,)
        drift_rad: Standard deviation of its angle, in radians. (B,)
    """
    shape = (-1, *[1] * (gaussians.rotations.dim() - 1))
    turn = motion[:, :2, :2].to(gaussians.means).view(*shape, 2, 2)
    shift = motion[:, :2, 3].to(gaussians.means).view(*shape, 2)
    drift_m, drift_rad = (d.to(shift).view(*shape, 1, 1) for d in (drift_m, drift_rad))
    means = (turn @ gaussians.means[..., None])[..., 0] + shift
    aside = torch.stack([-means[..., 1], means[..., 0]], -1)[..., None]
    covariance = turn @ covariances(gaussians) @ turn.transpose(-1, -2)
    noise = drift_m.square() * torch.eye(2).to(shift)
    noise = noise + drift_rad.square() * (aside @ aside.transpose(-1, -2))
    angles = gaussians.rotations + torch.atan2(turn[..., 1, 0], turn[..., 0, 0])
    return with_covariances(means, covariance + noise, angles)


def fused_gaussians(first: Gaussians, second: Gaussians) -> Gaussians:
    r"""Return the product of two Gaussians each: a Kalman update of the first by the second.

    With :math:`K = \Sigma_1 (\Sigma_1 + \Sigma_2)^{-1}` the centre is
    :math:`\mu_1 + K (\mu_2 - \mu_1)` and the covariance :math:`K \Sigma_2`; its first axis is the
    one close to the second's. (...), (...) -> (...)
    """
    one, two = covariances(first), covariances(second)
    (a, b), (c, d) = ((one + two)[..., row, :].unbind(-1) for row in (0, 1))
    adjugate = torch.stack([d, -b, -c, a], -1).unflatten(-1, (2, 2))
    gain = one @ adjugate / (a * d - b * c)[..., None, None]
    apart = (second.means - first.means)[..., None]
    means = first.means + (gain @ apart)[..., 0]
    return with_covariances(means, gain @ two, second.rotations)


def gaussians_along(points: Tensor, across_m: float) -> Gaussians:
    """Return Gaussians that cover lines: along them, half as long as their centres are apart.

    Args:
        points: Ordered centres in metres. (..., P, 2)
        across_m: Standard deviation across the line, and the smallest along it, in metres.
    """
    steps = points.diff(dim=-2).norm(dim=-1)
    apart = torch.cat([steps[..., :1], (steps[..., 1:] + steps[..., :-1]) / 2, steps[..., -1:]], -1)
    along = (apart / 2).clamp(min=across_m)
    scales = torch.stack([along, torch.full_like(along, across_m)], -1)
    return Gaussians(points, scales, angles_of_line(points))


def angles_of_line(points: Tensor) -> Tensor:
    """Return the line's direction at each point, in radians from +x. (..., P, 2) -> (..., P)"""
    padded = torch.cat([points[..., :1, :], points, points[..., -1:, :]], -2)
    along = padded[..., 2:, :] - padded[..., :-2, :]
    return torch.atan2(along[..., 1], along[..., 0])


def _rotations(angles: Tensor) -> Tensor:
    """Return rotation matrices (GSMap Eq. 4). (...) -> (..., 2, 2)"""
    cos, sin = angles.cos(), angles.sin()
    return torch.stack([cos, -sin, sin, cos], -1).unflatten(-1, (2, 2))


def extents_along_line(gaussians: Gaussians) -> Tensor:
    r"""Return each Gaussian's standard deviation along and across the line of its centres.

    :math:`\sqrt{d^T \Sigma d}` in metres; the line's direction d at a centre joins its neighbours,
    or at an end the end and its neighbour. Two or more Gaussians each. (..., P) -> (..., P, 2)
    """
    angles = angles_of_line(gaussians.means) - gaussians.rotations
    cos, sin = angles.cos().square(), angles.sin().square()
    first, second = gaussians.scales.square().unbind(-1)
    return torch.stack([first * cos + second * sin, first * sin + second * cos], -1).sqrt()


def stretched(gaussians: Gaussians, factors: Tensor) -> Gaussians:
    r"""Multiply each Gaussian's extents along and across the line of its centres.

    :math:`\Sigma' = M \Sigma M^T` with M diagonal in the directions of `extents_along_line`.

    Args:
        gaussians: Two or more for each line. (..., P)
        factors: Of the standard deviations along and across, > 0. (..., P, 2), or broadcast to it

    Returns:
        The Gaussians, the longer axis first. (..., P)
    """
    angles = angles_of_line(gaussians.means)
    cos, sin = (gaussians.rotations - angles).cos(), (gaussians.rotations - angles).sin()
    first, second = gaussians.scales.square().unbind(-1)
    both = factors.prod(-1) * (first - second) * sin * cos
    along = factors[..., 0].square() * (first * cos.square() + second * sin.square())
    across = factors[..., 1].square() * (first * sin.square() + second * cos.square())
    spread = ((along - across).square() / 4 + both.square()).sqrt()
    longer = ((along + across) / 2 + spread).sqrt()
    shorter = gaussians.scales.prod(-1) * factors.prod(-1) / longer  # the area is known
    turn = torch.atan2(2 * both, along - across) / 2
    return Gaussians(gaussians.means, torch.stack([longer, shorter], -1), angles + turn)


def line_errors(points: Tensor, targets: Tensor, lines: Tensor | None = None) -> Tensor:
    """Return how far points of predicted lines are off, along and across, in metres.

    Along: the distance from the point's own target, in the direction of the predicted line (as in
    `extents_along_line`). Across: the distance from the true line, whose ends go on straight, so
    that a line that is too long is not off to the side.

    Args:
        points: Predicted points in metres. (..., P, 2)
        targets: True points in their order, in metres. (..., P, 2)
        lines: The true lines at full resolution, or None for the targets. (..., S, 2)

    Returns:
        Both errors, >= 0. (..., P, 2)
    """
    angles = angles_of_line(points)
    direction = torch.stack([angles.cos(), angles.sin()], -1)
    along = ((points - targets) * direction).sum(-1).abs()
    lines = targets if lines is None else lines
    steps = lines.diff(dim=-2)[..., None, :, :]  # (..., 1, S - 1, 2)
    offsets = points[..., None, :] - lines[..., None, :-1, :]  # (..., P, S - 1, 2)
    lengths = steps.square().sum(-1)
    place = (offsets * steps).sum(-1) / lengths.clamp(min=_TINY)
    closed = (lines[..., :1, :] == lines[..., -1:, :]).all(-1, keepdim=True)  # (..., 1, 1)
    beyond = torch.where(closed, 0.0, torch.inf)
    inner = torch.zeros_like(lengths[..., 1:])
    low, high = torch.cat([-beyond, inner], -1), torch.cat([inner, beyond], -1) + 1
    apart = (offsets - place.clamp(low, high)[..., None] * steps).square().sum(-1)
    return torch.stack([along, apart.amin(-1).clamp(min=_TINY).sqrt()], -1)
