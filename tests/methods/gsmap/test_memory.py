"""Gaussians as memory: what is handed on, moved and fused; an empty memory changes nothing."""

import math

import numpy as np
import pytest
import torch
from head_cases import GSMAP, HEAD, build_head
from torch import Tensor

from gsmap.models.gsmap.memory import COVARIANCES, GaussianMemory
from gsmap.models.streams.memory import StreamMemory
from gsmap.structures.gaussians import covariances
from gsmap.structures.past import Past
from gsmap.structures.rigid import invert_rigid, rigid

FUSED = {"type": "GaussianMemory", "num": 2}


def features(number: int) -> Tensor:
    return torch.randn(1, 16, 10, 5, generator=torch.Generator().manual_seed(number))


def meta(number: int) -> dict:
    """Return the metainfo of a frame; the vehicle turns to the left and drives ahead."""
    cos, sin = math.cos(0.1 * number), math.sin(0.1 * number)
    pose = rigid([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]], [0, 2.0 * number, 0])
    at = {"timestamp_ns": number * 500_000_000, "lidar2global": pose}
    return {"token": str(number), "scene": "a", **at}


def with_memory(**queries):
    """Return a head of Gaussians and its memory, with weights that do something."""
    head = build_head(GSMAP)
    memory = StreamMemory(head, queries={**FUSED, **queries})
    torch.manual_seed(3)
    for parameter in (*memory.parameters(), *head.reference.parameters()):
        torch.nn.init.normal_(parameter, std=0.2)
    return head.eval(), memory.eval()


def step(head, memory, number: int):
    """Predict a frame; return the last layer's predictions, and the memory in the batch."""
    with (
        torch.no_grad(),
        memory.remember_batch({"bev_feats": features(number)}, [meta(number)]) as batch,
    ):
        return head(batch.outputs, **batch.hooks)[-1], batch.propagation


def past(seconds: float = 0.5, motion=None) -> Past:
    """Return the past of a stream that continues."""
    motion = torch.eye(4).double() if motion is None else torch.as_tensor(motion)
    return Past({}, motion[None], torch.tensor([seconds]).double(), torch.tensor([True]))


def of_first(head, handed_on: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Return means and covariances of the memory's Gaussians. (K, P, 2), (K, P, 2, 2)"""
    gaussians = head.reference.space.decode(handed_on.detach()[0])
    return gaussians.means.double().numpy(), covariances(gaussians).double().numpy()


@pytest.mark.parametrize("covariance", COVARIANCES)
def test_nothing_changes_while_the_memory_is_empty(covariance: str):
    head, memory = with_memory(covariance=covariance)
    with torch.no_grad():
        alone = head({"bev_feats": features(0)})[-1]
    first, _ = step(head, memory, 0)
    assert torch.equal(first.references, alone.references)
    assert torch.equal(first.scores, alone.scores)


def test_the_last_layers_gaussians_are_fused_with_those_before_point_by_point():
    head, memory = with_memory(noise_m=0.2, noise_deg=2.0)
    step(head, memory, 0)
    kept = memory.streams.states["a"].values["references"][None]
    refined: list[Tensor] = []
    fuse_references = memory.queries.fuse_references

    def record_and_fuse(**arguments):
        refined.append(arguments["refined"])
        return fuse_references(**arguments)

    memory.queries.fuse_references = record_and_fuse
    predicted, propagation = step(head, memory, 1)
    before, seen, fused = (
        of_first(head, lines)
        for lines in (propagation.propagated.reference, refined[0], predicted.references[:, :2])
    )
    then, spread = of_first(head, kept)
    motion = invert_rigid(meta(1)["lidar2global"]) @ meta(0)["lidar2global"]
    turn, sigmas = motion[:2, :2], np.array([0.2, math.radians(2.0)]) * math.sqrt(0.5)
    for element, point in np.ndindex(2, 5):
        one = element, point
        mean = turn @ then[one] + motion[:2, 3]
        aside = np.array([-mean[1], mean[0]])
        prior = turn @ spread[one] @ turn.T + sigmas[0] ** 2 * np.eye(2)
        prior += sigmas[1] ** 2 * np.outer(aside, aside)
        np.testing.assert_allclose(before[0][one], mean, atol=1e-3)
        np.testing.assert_allclose(before[1][one], prior, rtol=1e-3, atol=1e-4)
        gain = prior @ np.linalg.inv(prior + seen[1][one])
        mean = mean + gain @ (seen[0][one] - mean)
        np.testing.assert_allclose(fused[0][one], mean, atol=1e-3)
        wanted = (np.eye(2) - gain) @ prior
        np.testing.assert_allclose(fused[1][one], wanted, rtol=2e-3, atol=1e-4)
    assert not np.allclose(fused[0], seen[0], atol=0.1)  # it is not what was seen


def test_each_setting_hands_on_what_it_says():
    references = torch.tensor([0.5, 0.6, 0.4, -0.3, 0.2]).expand(1, 2, 5, 5)
    head, _ = with_memory()
    moved = {
        kind: GaussianMemory(16, num=2, covariance=kind).transform_references(
            head, references, past()
        )
        for kind in COVARIANCES
    }
    assert not moved["points"][..., 2:].any()
    torch.testing.assert_close(moved["points"][..., :2], references[..., :2])
    assert torch.equal(moved["moved"], moved["fused"])
    scales = head.reference.space.decode(moved["moved"]).scales
    assert (scales > head.reference.space.decode(references).scales).all()  # it is less certain
    for kind in ("points", "moved"):
        part = GaussianMemory(16, num=2, covariance=kind)
        assert part.fuse_references(references, moved[kind], head) is references


def test_without_noise_a_gaussian_is_moved_as_any_memory_moves_it():
    references = torch.rand(1, 2, 5, 5, generator=torch.Generator().manual_seed(0))
    head, _ = with_memory()
    motion = rigid([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [1, 2, 0])
    exact = GaussianMemory(16, num=2, noise_m=0.0, noise_deg=0.0)
    moved = exact.transform_references(head, references, past(motion=motion))
    plain = head.reference.transform_references(references, past(motion=motion).now_from_then)
    torch.testing.assert_close(moved, plain, atol=1e-5, rtol=1e-5)


def test_a_gaussian_that_left_the_map_is_not_fused():
    head, memory = with_memory()
    references = torch.tensor([0.5, 0.6, 0.4, -0.3, 0.2]).expand(1, 2, 5, 5)
    motion = rigid(np.eye(3), [0, 50, 0])  # 56 m ahead, where the map ends at 30
    before = memory.queries.transform_references(head, references, past(motion=motion))
    assert (before[..., 1] == 1).all()
    assert torch.equal(memory.queries.fuse_references(references, before, head), references)


def test_fused_predictions_train_the_decoder():
    head, memory = with_memory()
    step(head, memory, 0)
    with memory.remember_batch({"bev_feats": features(1)}, [meta(1)]) as batch:
        head(batch.outputs, **batch.hooks)[-1].references[:, :2].square().sum().backward()
    for branches in (head.reference.branches, head.reference.gaussian_branches):
        gradient = torch.cat([p.grad.flatten() for p in branches[-1].parameters()])
        assert gradient.isfinite().all()
        assert gradient.abs().max() > 0


def test_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="GaussianMemory needs Gaussians, got PointReference"):
        StreamMemory(build_head(HEAD), queries=FUSED)
    with pytest.raises(ValueError, match=r"covariance must be one of .* got 'kalman'"):
        GaussianMemory(16, covariance="kalman")
    with pytest.raises(ValueError, match="noise_m and noise_deg must be >= 0, got -1 and 1"):
        GaussianMemory(16, noise_m=-1)
