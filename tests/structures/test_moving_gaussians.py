"""Gaussians that move and are fused: against samples, numpy's Kalman filter and gradcheck."""

import math

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck

from gsmap.structures.gaussians import (
    ACTIVATIONS,
    Gaussians,
    GaussianSpace,
    covariances,
    fuse_gaussians,
    move_gaussians,
    with_covariances,
)
from gsmap.structures.grid import BEVGrid
from gsmap.structures.rigid import rigid

GRID = BEVGrid((-15, 15), (-30, 30))


def some(count: int = 6, seed: int = 0) -> Gaussians:
    """Return Gaussians of all directions, the last one round. (1, count)"""
    generator = torch.Generator().manual_seed(seed)
    draw = {"generator": generator, "dtype": torch.float64}
    means = 20 * torch.rand(1, count, 2, **draw) - 10
    scales = 0.3 + 2 * torch.rand(1, count, 2, **draw)
    scales[0, -1] = 0.7
    return Gaussians(means, scales, 7 * torch.rand(1, count, **draw) - 3.5)


def turned_by(yaw_rad: float, x_m: float = 0, y_m: float = 0) -> torch.Tensor:
    """Return a motion in the plane. (1, 4, 4)"""
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    return torch.as_tensor(rigid([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]], [x_m, y_m, 0]))[None]


def test_a_moved_gaussian_is_that_of_its_moved_samples():
    """A hundred thousand samples of each are moved one by one, by a motion that is uncertain."""
    before, motion = some(), turned_by(0.9, 1.0, -4.0)
    drift = torch.tensor([0.4]), torch.tensor([0.05])
    after = move_gaussians(before, motion, *drift)
    rng = np.random.default_rng(0)
    for index in range(6):
        mean, spread = before.means[0, index].numpy(), covariances(before)[0, index].numpy()
        samples = rng.multivariate_normal(mean, spread, 100_000)
        mean = samples.mean(0)  # the angle moves what is far off, here the centre
        angles = 0.05 * rng.standard_normal(len(samples))
        samples = samples @ motion[0, :2, :2].numpy().T + motion[0, :2, 3].numpy()
        aside = np.stack([-after.means[0, index, 1], after.means[0, index, 0]])
        samples += angles[:, None] * aside + 0.4 * rng.standard_normal(samples.shape)
        np.testing.assert_allclose(samples.mean(0), after.means[0, index], atol=0.03)
        np.testing.assert_allclose(np.cov(samples.T), covariances(after)[0, index], atol=0.1)


def test_without_noise_a_gaussian_turns_and_keeps_its_size():
    before = some()
    after = move_gaussians(before, turned_by(2.0, 3.0), torch.zeros(1), torch.zeros(1))
    torch.testing.assert_close(after.rotations, before.rotations + 2.0)
    torch.testing.assert_close(after.scales, before.scales)


def test_a_motion_of_each_stream_moves_its_own():
    both = Gaussians(*(torch.cat([part, part]) for part in some()))
    motions = torch.cat([turned_by(0.0), turned_by(math.pi)])
    after = move_gaussians(both, motions, torch.zeros(2), torch.zeros(2))
    torch.testing.assert_close(after.means[0], both.means[0])
    torch.testing.assert_close(after.means[1], -both.means[1])


def test_fusing_is_a_kalman_update():
    first, second = some(seed=1), some(seed=2)
    fused = fuse_gaussians(first, second)
    for index in range(6):
        one, two = (covariances(g)[0, index].numpy() for g in (first, second))
        mean, seen = (g.means[0, index].numpy() for g in (first, second))
        gain = one @ np.linalg.inv(one + two)
        np.testing.assert_allclose(fused.means[0, index], mean + gain @ (seen - mean))
        np.testing.assert_allclose(covariances(fused)[0, index], (np.eye(2) - gain) @ one)
        product = np.linalg.inv(np.linalg.inv(one) + np.linalg.inv(two))
        np.testing.assert_allclose(covariances(fused)[0, index], product)


def test_a_precise_gaussian_wins_and_axes_stay_where_they_were():
    """Far more precise along x, as far less along y: the place is of one, then of the other."""
    first = Gaussians(torch.zeros(1, 2), torch.tensor([[0.01, 100.0]]), torch.tensor([0.0]))
    second = Gaussians(torch.ones(1, 2), torch.tensor([[1.0, 1.0]]), torch.tensor([0.3]))
    fused = fuse_gaussians(first, second)
    torch.testing.assert_close(fused.means, torch.tensor([[0.0, 1.0]]), atol=1e-3, rtol=0)
    torch.testing.assert_close(fused.rotations, torch.tensor([0.0]), atol=1e-3, rtol=0)
    torch.testing.assert_close(fused.scales, torch.tensor([[0.01, 1.0]]), atol=1e-3, rtol=0)


@pytest.mark.parametrize("turns", [-1.5, -0.5, 0.0, 0.5, 1.0])
def test_an_ellipse_keeps_the_angle_that_it_is_near(turns: float):
    """The first axis stays within an eighth of a turn of ``near``, whichever is the longer."""
    before = some()
    near = before.rotations + turns * math.pi
    after = with_covariances(before.means, covariances(before), near)
    torch.testing.assert_close(covariances(after), covariances(before))
    assert ((after.rotations - near).abs() <= math.pi / 4 + 1e-9).all()


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("literal", [False, True])
def test_encoding_is_the_inverse_of_decoding(activation: str, literal: bool):
    space = GaussianSpace(GRID, activation=activation, literal_covariance=literal)
    generator = torch.Generator().manual_seed(0)
    references = torch.rand(5, 6, generator=generator, dtype=torch.float64)  # with a height
    again = space.encode(space.decode(references), references)
    torch.testing.assert_close(again, references)
    extreme = Gaussians(
        torch.full((2, 2), 99.0), torch.tensor([[1e-9] * 2, [1e9] * 2]), torch.ones(2)
    )
    found = space.decode(space.encode(extreme, torch.zeros(2, 5)))
    assert found.means.tolist() == [[15.0, 30.0]] * 2
    ends = space.scales(torch.tensor([[-30.0] * 2, [30.0] * 2]))
    ends = ends.square() if literal else ends
    torch.testing.assert_close(found.scales, ends, rtol=0.01, atol=0)


def test_gradients_of_moving_and_fusing():
    def fuse(*parts: torch.Tensor) -> Gaussians:
        return fuse_gaussians(Gaussians(*parts[:3]), Gaussians(*parts[3:]))

    def move(*parts: torch.Tensor) -> Gaussians:
        drifts = torch.tensor([0.3]), torch.tensor([0.1])
        return move_gaussians(Gaussians(*parts), turned_by(0.4, 2.0), *drifts)

    oblong = [part[:, :-1].clone().requires_grad_() for part in some(seed=3)]
    other = [part[:, :-1].clone().requires_grad_() for part in some(seed=4)]
    assert gradcheck(move, oblong)
    assert gradcheck(fuse, oblong + other)


def test_a_round_gaussian_has_finite_gradients():
    parts = [part[:, -1:].clone().requires_grad_() for part in some()]
    fused = fuse_gaussians(Gaussians(*parts), Gaussians(*(part.detach() for part in parts)))
    sum(part.sum() for part in fused).backward()
    assert all(part.grad.isfinite().all() for part in parts[:2])
    torch.testing.assert_close(fused.scales, parts[1] / math.sqrt(2))
