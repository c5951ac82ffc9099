"""2D Gaussians as parts of map elements, and their encoding as references of a decoder."""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from gsmap.structures.grid import BEVGrid
from gsmap.structures.tensors import at_least_float32, cached_constant, constant
from gsmap.utils.errors import InputError

ACTIVATIONS = ("sigmoid", "softplus", "exp")
_ROUND = 1e-6  # relative difference of both variances below which a Gaussian has no direction
# Distance of an encoded sigma from the ends of its range, as a share of the range. At the ends, the
# inverse of the activation may be infinite.
_MARGIN = 1e-4
_TINY = 1e-12  # lower bound of squared lengths in square metres, which are divisors or under a root
AT_FLOOR = 1.1  # a Gaussian is at the lower bound if both sigmas are below this multiple of it


class Gaussians(NamedTuple):
    """Ordered 2D Gaussians G = (mu, sigma, theta) (GSMap Eq. 1).

    Attributes:
        means: Centres mu in metres. (..., 2)
        scales: Standard deviations sigma along the axes of each Gaussian, in metres. (..., 2)
        rotations: Angle theta of the first axis from +x, in radians, anticlockwise. (...)
    """

    means: Tensor
    scales: Tensor
    rotations: Tensor


@dataclass(frozen=True)
class GaussianSpace:
    r"""Encoding of Gaussians as references of a decoder.

    A reference is the vector that the decoder layers refine for each point, like the reference
    points in Deformable DETR. Its first entries are the centre, [0, 1] over the map. Its last three
    entries encode sigma (2) and theta (1) and are zero for the initial Gaussian of a query. The
    initial Gaussian lies along the direction of travel, since a round one has no direction and no
    gradient in theta.

    Args:
        grid: Extent and direction of travel of the map; its raster is not used.
        min_scale_m: Smallest sigma in metres. The default is half a pixel of the training raster: a
            smaller Gaussian falls between pixels and gets no gradient.
        max_scale_m: Largest sigma in metres.
        init_scales_m: Sigma of the initial Gaussian of a query, along and across the direction of
            travel, in metres.
        activation: Function from an entry s of a reference to sigma. ``"sigmoid"`` is
            min + (max - min) sigmoid(s + s_0), ``"softplus"`` is min + softplus(s + s_0), and
            ``"exp"`` is min + exp(s + s_0). The last two are clamped to the largest sigma. The
            offset s_0 is such that s = 0 gives the initial sigma.
        literal_covariance: Use S = diag(sigma^2) as printed in GSMap Eq. 3, so that the standard
            deviations are the squares of sigma.

    Raises:
        ValueError: If not 0 < min < init < max for both axes, or ``activation`` is unknown.
    """

    grid: BEVGrid
    min_scale_m: float = 0.15
    max_scale_m: float = 5.0
    init_scales_m: tuple[float, float] = (1.0, 0.4)
    activation: str = "sigmoid"
    literal_covariance: bool = False
    # Offset s_0 of sigma before its activation. (2,)
    _start: tuple[float, ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        # A frozen dataclass can only be set by `object.__setattr__`.
        object.__setattr__(self, "init_scales_m", tuple(float(s) for s in self.init_scales_m))
        if not all(0 < self.min_scale_m < s < self.max_scale_m for s in self.init_scales_m):
            raise InputError(
                "0 < min_scale_m < init_scales_m < max_scale_m must hold, got "
                f"{self.min_scale_m}, {self.init_scales_m}, {self.max_scale_m}."
            )
        if self.activation not in ACTIVATIONS:
            raise InputError(f"activation must be one of {ACTIVATIONS}, got {self.activation!r}.")
        initial = torch.tensor(self.init_scales_m, dtype=torch.float64)
        object.__setattr__(self, "_start", tuple(self._before_activation(initial).tolist()))

    @property
    def floor_m(self) -> float:
        """Smallest standard deviation in metres."""
        return self.min_scale_m**2 if self.literal_covariance else self.min_scale_m

    @property
    def heading_rad(self) -> float:
        """Angle of the direction of travel from +x in radians."""
        return 0.0 if self.grid.forward == "x" else math.pi / 2

    def decode(self, reference: Tensor) -> Gaussians:
        """Decode the Gaussians of references.

        Args:
            reference: Centre in [0, 1] over the map, possibly a height, then sigma (2) and theta
                (1) before their activation. (..., 5 or more)

        Returns:
            Gaussians, differentiable, at least float32. (...)

        Raises:
            ValueError: If a reference has fewer than five entries.
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
        return Gaussians(means, scales, rotations=reference[..., -1] + self.heading_rad)

    def scales(self, raw: Tensor) -> Tensor:
        """Apply the activation to get sigma in metres; zero gives ``init_scales_m``. (..., 2)"""
        shifted = raw + constant(raw, self._start)
        if self.activation == "sigmoid":
            span = constant(raw, self.max_scale_m - self.min_scale_m)
            # min + (max - min) sigmoid(s + s_0) in one operation.
            return torch.addcmul(constant(raw, self.min_scale_m), shifted.sigmoid(), span)
        # `above` is the distance of sigma from its lower bound, in metres.
        above = F.softplus(shifted) if self.activation == "softplus" else shifted.exp()
        return (self.min_scale_m + above).clamp(max=self.max_scale_m)

    def _before_activation(self, scales: Tensor) -> Tensor:
        """Invert the activation: s + s_0 for sigma in metres, min < sigma < max. (...) -> (...)"""
        above = scales - self.min_scale_m
        if self.activation == "sigmoid":
            return (above / (self.max_scale_m - scales)).log()
        if self.activation == "softplus":
            return above.expm1().log()
        return above.log()

    def encode(self, gaussians: Gaussians, like: Tensor) -> Tensor:
        """Encode Gaussians as references, the inverse of `decode`.

        A centre outside of the map is moved to its border, and sigma is clamped to its range.

        Args:
            gaussians: Gaussians. (...)
            like: References whose heights, if they have any, are copied to the result. (..., D)

        Returns:
            References, differentiable. (..., D)
        """
        centres = self.grid.norm_from_metres(gaussians.means).clamp(0.0, 1.0)
        scales = gaussians.scales.sqrt() if self.literal_covariance else gaussians.scales
        margin = _MARGIN * (self.max_scale_m - self.min_scale_m)
        scales = scales.clamp(self.min_scale_m + margin, self.max_scale_m - margin)
        raw = self._before_activation(scales) - constant(scales, self._start)
        theta = gaussians.rotations[..., None] - self.heading_rad
        return torch.cat([centres, like[..., 2:-3], raw, theta], dim=-1)

    def frames(
        self,
        reference: Tensor,
        invariant: bool = False,
        cell_m: tuple[float, float] = (1.0, 1.0),
    ) -> Tensor:
        r"""Compute matrices that transform offsets by the orientation and size of each Gaussian.

        With the stretch :math:`D = \mathrm{diag}(\sigma / \sigma_{init})` and the direction of
        travel :math:`\theta_0`, the matrix is :math:`R(\theta) D R(\theta_0)^T`. The invariant
        matrix :math:`R(\theta) D R(\theta)^T` is equal for theta and theta + pi, which describe one
        Gaussian. Both are exactly the identity for the initial Gaussian of a query.

        The method runs once for each of the six decoder layers of a frame. To save operations, each
        of which is a launch on a GPU, products of constants are computed beforehand.

        Args:
            reference: References of the decoder. (..., D)
            invariant: Whether to compute the invariant matrices.
            cell_m: Size of a cell along x and y in metres, if the offsets are in cells. The default
                is for offsets in metres.

        Returns:
            Matrices that multiply offsets (x, y) from the left. (..., 2, 2)
        """
        reference = at_least_float32(reference)
        scales = self.scales(reference[..., -3:-1])
        if self.literal_covariance:
            scales = scales.square()
        # Computed like the scales, so that the quotient is exactly one for the initial Gaussian.
        # The cache key has this object, because the values depend on its settings.
        start = cached_constant(
            scales, (self, "start", scales.dtype), make=lambda: self._initial_scales(scales)
        )
        stretch = scales / start
        theta = reference[..., -1:]  # angle from the direction of travel
        # Factors of the entries off the diagonal, for offsets in cells that are not square.
        x_per_y = cell_m[0] / cell_m[1]
        y_per_x = cell_m[1] / cell_m[0]
        along_x = self.grid.forward == "x"
        if invariant:
            # R diag(a, b) R^T is [[middle + half cos, half sin], [half sin, middle - half cos]],
            # with middle = (a + b) / 2, half = (a - b) / 2, and cos and sin of twice the angle.
            cos, sin = self._double_angle(theta).split(1, dim=-1)
            middle = (stretch[..., :1] + stretch[..., 1:]) / 2
            half = (stretch[..., :1] - stretch[..., 1:]) / 2
            cross = half * sin
            entries = [middle + half * cos, cross * y_per_x, cross * x_per_y, middle - half * cos]
            return torch.cat(entries, dim=-1).unflatten(-1, (2, 2))
        # Theta is the angle from the direction of travel, and a and b are the stretches along both
        # axes. The entries of the result are the products (a cos, a sin, b cos, b sin), each with a
        # constant factor. A constant matrix, whose rows belong to the products and whose columns
        # belong to the entries (xx, xy, yx, yy), has these factors.
        turn = _cos_and_sin(theta, factor=1.0, shift_rad=0.0)
        products = (stretch[..., :, None] * turn[..., None, :]).flatten(-2)  # (..., 4)
        x_rows = [(1, 0, 0, 0), (0, 0, x_per_y, 0)]  # for the stretch along x
        y_rows = [(0, 0, 0, 1), (0, -y_per_x, 0, 0)]  # for the stretch along y
        # The stretch a, whose products come first, is along the direction of travel.
        rows = [*x_rows, *y_rows] if along_x else [*y_rows, *x_rows]
        return (products @ constant(products, rows)).unflatten(-1, (2, 2))

    def _initial_scales(self, like: Tensor) -> Tensor:
        """Standard deviations of the initial Gaussian of a query. (2,)"""
        start = self.scales(like.new_zeros(2))
        return start.square() if self.literal_covariance else start

    def _double_angle(self, theta: Tensor) -> Tensor:
        """Cosine and sine of twice the angle from +x.

        Args:
            theta: Angle from the direction of travel, as in a reference. (..., 1)

        Returns:
            Cosine and sine, which are equal for theta and theta + pi. (..., 2)
        """
        return _cos_and_sin(theta, factor=2.0, shift_rad=2 * self.heading_rad)

    def describe(self, reference: Tensor) -> Tensor:
        """Describe Gaussians by features of about size 1, which are equal for theta and theta + pi.

        Args:
            reference: References of the decoder. (..., 5 or more)

        Returns:
            mu in [-1, 1], sigma before its activation, cosine and sine of 2 theta. (..., 6)
        """
        # 2 * centre - 1 in one operation.
        centre = torch.add(constant(reference, -1.0), reference[..., :2], alpha=2)
        angle = self._double_angle(reference[..., -1:])
        return torch.cat([centre, reference[..., -3:-1], angle], dim=-1)


def _cos_and_sin(angle: Tensor, factor: float, shift_rad: float) -> Tensor:
    """Cosine and sine of ``factor * angle + shift_rad`` by two operations. (..., 1) -> (..., 2)"""
    shifts = constant(angle, (shift_rad + math.pi / 2, shift_rad))  # cos x = sin(x + pi / 2)
    return torch.addcmul(shifts, angle, constant(angle, factor)).sin()


def covariances(gaussians: Gaussians) -> Tensor:
    """Covariances of Gaussians (GSMap Eq. 2) in square metres. (...) -> (..., 2, 2)"""
    axes = _rotation_matrices(gaussians.rotations) * gaussians.scales[..., None, :]
    return axes @ axes.transpose(-1, -2)


def with_covariances(means: Tensor, covariances: Tensor, near: Tensor) -> Gaussians:
    """Create Gaussians from covariances, differentiable also for round Gaussians.

    Args:
        means: Centres in metres. (..., 2)
        covariances: Symmetric, positive definite matrices in square metres. (..., 2, 2)
        near: Angle in radians that selects one of the equivalent rotations: the first axis is
            within an eighth of a turn of it. (...)

    Returns:
        Gaussians. (...)
    """
    near = near.detach()  # the covariance does not depend on it
    frame = _rotation_matrices(near)
    local = frame.transpose(-1, -2) @ covariances @ frame
    # The matrix [[middle + half, cross], [cross, middle - half]] has the eigenvalues
    # middle + radius and middle - radius, and its first axis is at half the angle of (half, cross).
    middle = (local[..., 0, 0] + local[..., 1, 1]) / 2
    half = (local[..., 0, 0] - local[..., 1, 1]) / 2
    cross = (local[..., 0, 1] + local[..., 1, 0]) / 2
    is_round = half.square() + cross.square() <= (_ROUND * middle).square()
    # Neither the root nor the angle has a gradient at zero: round Gaussians get other values here.
    half = torch.where(is_round, torch.ones_like(half), half)
    cross = torch.where(is_round, torch.zeros_like(cross), cross)
    # If half < 0, the axis of the larger eigenvalue is more than an eighth of a turn from `near`.
    # The first axis is then the axis of the smaller eigenvalue: the sign turns the angle to this
    # axis, and makes the radius negative.
    sign = torch.where(half < 0, -1.0, 1.0)
    angle = torch.atan2(sign * cross, half.abs()) / 2
    radius = torch.where(is_round, 0.0, sign * (half.square() + cross.square()).sqrt())
    scales = torch.stack([middle + radius, middle - radius], dim=-1).sqrt()
    return Gaussians(means, scales, rotations=near + angle)


def move_gaussians(
    gaussians: Gaussians, motion: Tensor, drift_m: Tensor, drift_rad: Tensor
) -> Gaussians:
    r"""Transform Gaussians to another frame and add the uncertainty of the motion.

    With the rotation R and translation t of the motion, the centre becomes :math:`R \mu + t` and
    the covariance :math:`R \Sigma R^T + \sigma_t^2 I + \sigma_r^2 p p^T`, where p is the new centre
    turned by 90 degrees: the error of an angle grows with the distance.

    Args:
        gaussians: Gaussians in the first frame. (B, ...)
        motion: Transform from the first frame to the other one, in metres. (B, 4, 4)
        drift_m: Standard deviation of the translation along each axis, in metres. (B,)
        drift_rad: Standard deviation of the rotation, in radians. (B,)

    Returns:
        Gaussians in the other frame. (B, ...)
    """
    # Values of each sample are repeated over the other dimensions of the Gaussians.
    shape = (-1, *[1] * (gaussians.rotations.dim() - 1))
    turn = motion[:, :2, :2].to(gaussians.means).view((*shape, 2, 2))
    shift = motion[:, :2, 3].to(gaussians.means).view((*shape, 2))
    drift_m = drift_m.to(shift).view((*shape, 1, 1))
    drift_rad = drift_rad.to(shift).view((*shape, 1, 1))
    means = (turn @ gaussians.means[..., None])[..., 0] + shift
    # The new centre turned by 90 degrees, p in the equation.
    aside = torch.stack([-means[..., 1], means[..., 0]], dim=-1)[..., None]
    covariance = turn @ covariances(gaussians) @ turn.transpose(-1, -2)
    noise = drift_m.square() * torch.eye(2).to(shift)
    noise = noise + drift_rad.square() * (aside @ aside.transpose(-1, -2))
    angles = gaussians.rotations + torch.atan2(turn[..., 1, 0], turn[..., 0, 0])
    return with_covariances(means, covariance + noise, near=angles)


def fuse_gaussians(first: Gaussians, second: Gaussians) -> Gaussians:
    r"""Multiply pairs of Gaussians: a Kalman update of the first by the second.

    With :math:`K = \Sigma_1 (\Sigma_1 + \Sigma_2)^{-1}` the centre is
    :math:`\mu_1 + K (\mu_2 - \mu_1)` and the covariance :math:`K \Sigma_2`.

    Args:
        first: Gaussians. (...)
        second: Gaussians. Their rotations select the first axes of the products
            (`with_covariances`). (...)

    Returns:
        Products. (...)
    """
    covariance_1 = covariances(first)
    covariance_2 = covariances(second)
    total = covariance_1 + covariance_2
    a, b = total[..., 0, :].unbind(-1)
    c, d = total[..., 1, :].unbind(-1)
    # The inverse of a matrix is its adjugate divided by its determinant.
    adjugate = torch.stack([d, -b, -c, a], dim=-1).unflatten(-1, (2, 2))
    determinant = a * d - b * c
    gain = covariance_1 @ adjugate / determinant[..., None, None]
    offset = (second.means - first.means)[..., None]
    means = first.means + (gain @ offset)[..., 0]
    return with_covariances(means, gain @ covariance_2, near=second.rotations)


def gaussians_along(points: Tensor, across_m: float) -> Gaussians:
    """Create Gaussians that cover lines.

    The sigma of a point along its line is half the mean distance to its neighbours, at least
    ``across_m``.

    Args:
        points: Ordered centres in metres. (..., P, 2)
        across_m: Standard deviation across the line in metres.

    Returns:
        Gaussians. (..., P)
    """
    steps = points.diff(dim=-2).norm(dim=-1)
    inner = (steps[..., 1:] + steps[..., :-1]) / 2
    # An end of a line has only one neighbour.
    distances = torch.cat([steps[..., :1], inner, steps[..., -1:]], dim=-1)
    along = (distances / 2).clamp(min=across_m)
    scales = torch.stack([along, torch.full_like(along, across_m)], dim=-1)
    return Gaussians(points, scales, rotations=angles_of_line(points))


def angles_of_line(points: Tensor) -> Tensor:
    """Direction of a line at each point, in radians from +x. (..., P, 2) -> (..., P)

    It is the direction from the previous point to the next one. At an end of the line, the point
    itself replaces the missing one.
    """
    padded = torch.cat([points[..., :1, :], points, points[..., -1:, :]], dim=-2)
    along = padded[..., 2:, :] - padded[..., :-2, :]
    return torch.atan2(along[..., 1], along[..., 0])


def _rotation_matrices(angles: Tensor) -> Tensor:
    """Rotation matrices (GSMap Eq. 4). (...) -> (..., 2, 2)"""
    cos = angles.cos()
    sin = angles.sin()
    return torch.stack([cos, -sin, sin, cos], dim=-1).unflatten(-1, (2, 2))


def extents_along_line(gaussians: Gaussians) -> Tensor:
    r"""Compute the standard deviations of Gaussians along and across the line of their centres.

    A standard deviation is :math:`\sqrt{d^T \Sigma d}` for a unit vector d along or across the
    line. The direction of the line at a centre is the direction from the previous centre to the
    next one; at an end of the line, the centre itself replaces the missing one.

    Args:
        gaussians: Gaussians of each line, two or more. (..., P)

    Returns:
        Standard deviations along and across the line, in metres. (..., P, 2)
    """
    angles = angles_of_line(gaussians.means) - gaussians.rotations
    cos_squared = angles.cos().square()
    sin_squared = angles.sin().square()
    first, second = gaussians.scales.square().unbind(-1)  # variances along the Gaussian's axes
    along = first * cos_squared + second * sin_squared
    across = first * sin_squared + second * cos_squared
    return torch.stack([along, across], dim=-1).sqrt()


def stretch_along_line(gaussians: Gaussians, factors: Tensor) -> Gaussians:
    r"""Multiply the extents of Gaussians along and across the line of their centres.

    The covariance becomes :math:`M \Sigma M^T` with M diagonal in the directions of
    `extents_along_line`.

    Args:
        gaussians: Gaussians of each line, two or more. (..., P)
        factors: Factors of the standard deviations along and across the line, > 0, broadcast to
            (..., P, 2).

    Returns:
        Gaussians whose first axis is the longer one. (..., P)
    """
    angles = angles_of_line(gaussians.means)
    cos = (gaussians.rotations - angles).cos()
    sin = (gaussians.rotations - angles).sin()
    first, second = gaussians.scales.square().unbind(-1)
    # In the directions along and across, the covariance is [[along, cross], [cross, across]].
    cross = factors.prod(-1) * (first - second) * sin * cos
    along = factors[..., 0].square() * (first * cos.square() + second * sin.square())
    across = factors[..., 1].square() * (first * sin.square() + second * cos.square())
    # The larger eigenvalue of the matrix is its mean diagonal entry plus `radius`.
    radius = ((along - across).square() / 4 + cross.square()).sqrt()
    longer = ((along + across) / 2 + radius).sqrt()
    # The factors multiply the area of the ellipse, which is proportional to longer * shorter.
    shorter = gaussians.scales.prod(-1) * factors.prod(-1) / longer
    turn = torch.atan2(2 * cross, along - across) / 2  # of the longer axis from the line
    scales = torch.stack([longer, shorter], dim=-1)
    return Gaussians(gaussians.means, scales, rotations=angles + turn)


def line_errors(points: Tensor, targets: Tensor, lines: Tensor | None = None) -> Tensor:
    """Compute the errors of points of predicted lines along and across the lines.

    The error along is the distance of a point from its target in the direction of the predicted
    line (see `extents_along_line`). The error across is the distance of a point from the true line.
    The ends of the true line are extended straight, so that a prediction that is too long has no
    error across.

    Args:
        points: Predicted points in metres. (..., P, 2)
        targets: Target of each point, in metres. (..., P, 2)
        lines: True lines at full resolution, in metres; None to use the targets. (..., S, 2)

    Returns:
        Errors along and across in metres, >= 0; errors across are at least 1e-6. (..., P, 2)
    """
    angles = angles_of_line(points)
    direction = torch.stack([angles.cos(), angles.sin()], dim=-1)
    along = ((points - targets) * direction).sum(-1).abs()
    lines = targets if lines is None else lines
    steps = lines.diff(dim=-2)[..., None, :, :]  # (..., 1, S - 1, 2)
    offsets = points[..., None, :] - lines[..., None, :-1, :]  # (..., P, S - 1, 2)
    squared_lengths = steps.square().sum(-1)
    # Position of the nearest point on each segment: 0 at its start and 1 at its end.
    position = (offsets * steps).sum(-1) / squared_lengths.clamp(min=_TINY)
    # The position is clamped to [0, 1]. Only on an open line, it may be less than 0 on the first
    # segment and more than 1 on the last segment.
    closed = (lines[..., :1, :] == lines[..., -1:, :]).all(-1, keepdim=True)  # (..., 1, 1)
    beyond = torch.where(closed, 0.0, torch.inf)
    inner = torch.zeros_like(squared_lengths[..., 1:])  # (..., 1, S - 2)
    # Lower limits are 0, but -inf on the first segment of an open line. Upper limits are 1, but inf
    # on the last segment of an open line. (..., 1, S - 1)
    low = torch.cat([-beyond, inner], dim=-1)
    high = torch.cat([inner, beyond], dim=-1) + 1
    nearest = position.clamp(low, high)[..., None] * steps  # from the start of each segment
    squared_distances = (offsets - nearest).square().sum(-1)
    # The root has an infinite gradient at zero, so the distance is clamped.
    across = squared_distances.amin(-1).clamp(min=_TINY).sqrt()
    return torch.stack([along, across], dim=-1)
