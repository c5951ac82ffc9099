"""HDMapNet's vectorising: drawn lines come back, the same ones each time; messages for bad maps."""

import random
from itertools import pairwise

import cv2
import numpy as np
import pytest
import torch

from gsmap.models.hdmapnet.vectorizing import (
    TracedLine,
    VectorizeConfig,
    clean_mask,
    cluster_pixels,
    elements_of_lines,
    order_by_distance,
    ridge_pixels,
    top_directions,
    trace,
    vectorize,
)

SIZE = (80, 160)
DRAWN = [  # class, (column, row) of vertices
    (0, [(10, 10), (150, 10)]),
    (0, [(10, 30), (80, 30), (150, 60)]),
    (1, [(20, 40), (20, 75)]),
]


def maps(noise: float = 0.05) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """What a network would say of the drawn lines: classes, embeddings, directions."""
    rng = np.random.default_rng(0)
    semantic, direction = np.full((3, *SIZE), -4.0), np.zeros((37, *SIZE))
    embedding = 0.1 * rng.normal(size=(4, *SIZE))
    semantic[0], direction[0] = 0, 2
    for number, (label, vertices) in enumerate(DRAWN):
        for a, b in pairwise(vertices):
            wide, thin = np.zeros(SIZE, np.uint8), np.zeros(SIZE, np.uint8)
            for canvas, thickness in ((wide, 5), (thin, 1)):
                cv2.line(canvas, a, b, 1, thickness)
            semantic[label + 1] += 6.0 * wide + 1.0 * thin  # most probable in the middle
            angle = np.degrees(np.arctan2(b[1] - a[1], b[0] - a[0]))
            for way in (angle, angle + 180):
                direction[round(way / 10) % 36 + 1] += 5.0 * wide
            embedding[number][wide > 0] = 3
    semantic += noise * rng.normal(size=semantic.shape)
    return tuple(torch.from_numpy(values).float() for values in (semantic, embedding, direction))


def test_drawn_lines_come_back_from_end_to_end():
    lines = vectorize(*maps())
    assert [line.label for line in lines] == [0, 0, 1]
    for line, (_, vertices) in zip(lines, DRAWN, strict=True):
        truth = np.array(vertices, float)
        ends = line.pixels[[0, -1]]
        ends = ends if np.abs(ends - truth[[0, -1]]).sum() < 20 else ends[::-1]
        assert np.abs(ends - truth[[0, -1]]).max() <= 8  # a step may remain
        steps = np.hypot(*np.diff(line.pixels, axis=0).T)
        assert (steps > 6).all()
        assert (steps < 15).all()
        dense = np.concatenate([np.linspace(a, b, 200) for a, b in pairwise(truth)])
        off = np.linalg.norm(line.pixels[:, None] - dense, axis=-1).min(1)
        assert off.max() < 4  # lines are 5 pixels wide
        assert 0.5 < line.score < 1


def test_the_same_maps_give_the_same_lines_and_chance_is_asked_for():
    first, second = vectorize(*maps()), vectorize(*maps())
    assert all((a.pixels == b.pixels).all() for a, b in zip(first, second, strict=True))
    asked = []

    def choose(count: int) -> int:
        asked.append(count)
        return random.Random(len(asked)).randrange(count)

    other = vectorize(*maps(), choose_start=choose)
    assert len(asked) == 3
    assert any(
        a.pixels.shape != b.pixels.shape or (a.pixels != b.pixels).any()
        for a, b in zip(first, other, strict=True)
    )


def test_nothing_found_gives_no_line():
    semantic, embedding, direction = maps()
    semantic[0] += 100
    assert vectorize(semantic, embedding, direction) == []
    assert len(elements_of_lines([], (0, 0), (1, 1))) == 0


def test_small_components_and_gaps():
    mask = np.zeros((40, 40), bool)
    mask[4:14, 4:14] = True  # 100 pixels: not more
    mask[20:31, 5:16] = True
    mask[25, 10] = False
    kept = clean_mask(mask, 100)
    assert not kept[:15].any()
    assert kept[20:31, 5:16].all()
    assert clean_mask(mask, 99)[4:14, 4:14].all()


def test_clusters_are_numbered_from_above_and_noise_is_none():
    mask = np.ones((10, 40), bool)
    embedding = np.zeros((2, 10, 40))
    embedding[0, 5:] = 10
    embedding[1, 0, 0] = 1000  # far from all
    found = cluster_pixels(mask, embedding, VectorizeConfig())
    assert found[0, 0] == 0
    assert (found[:5].ravel()[1:] == 1).all()
    assert (found[5:] == 2).all()
    assert not cluster_pixels(~mask, embedding, VectorizeConfig()).any()


@pytest.mark.parametrize("upright", [False, True])
def test_a_ridge_is_one_pixel_wide(upright):
    probs = np.zeros((31, 31))
    probs[10:15, 4:27] = np.array([0.5, 0.7, 0.9, 0.7, 0.5])[:, None]
    probs = probs.T if upright else probs
    ridge = ridge_pixels(probs, 1e-4)
    ridge = ridge.T if upright else ridge
    assert set(np.nonzero(ridge[:, 8:22])[0].tolist()) == {12}


def test_points_of_a_place_that_has_been_passed_are_left_out():
    line = np.array([[column, 0] for column in range(0, 60, 2)])
    aside = np.array([[10, 4]])  # 4 px away from what has been passed
    found = order_by_distance(np.concatenate([line, aside]))
    np.testing.assert_array_equal(found, line)
    far = np.concatenate([line, [[90, 0]]])  # the last tenth, more than 10 px away
    np.testing.assert_array_equal(order_by_distance(far), line)
    assert order_by_distance(np.zeros((0, 2), int)).shape == (0, 2)


def test_points_are_ordered_from_nearest_to_nearest_as_by_hand():
    """Every pixel of wide lines, as of saturated maps; a plain loop over the rules."""
    rng = np.random.default_rng(0)
    for wide in (1, 3, 6):
        image = np.zeros((40, 60), np.uint8)
        for a, b in rng.integers(0, 40, (4, 2, 2)):
            cv2.line(image, a.tolist(), b.tolist(), 1, wide)
        points = np.stack(np.nonzero(image)[::-1], 1)
        left, chosen = list(range(1, len(points))), [0]
        for step in range(len(points) - 1):
            apart = np.hypot(*(points[left] - points[chosen[-1]]).T)
            nearest = left.pop(int(apart.argmin()))
            passed = np.hypot(*(points[chosen] - points[nearest]).T).min() < 5
            if apart.min() > 3 and passed:
                continue
            if apart.min() > 10 and step > 0.9 * len(points):
                break
            chosen.append(nearest)
        np.testing.assert_array_equal(order_by_distance(points), points[chosen])


def test_directions_beside_the_best_are_not_the_second():
    logits = torch.zeros(37, 1, 1)
    logits[10], logits[12], logits[13], logits[11] = 5.0, 4.0, 3.0, 4.5
    assert top_directions(logits).ravel().tolist() == [9, 12]
    logits[0] = 9.0
    assert top_directions(logits).ravel().tolist() == [-1, 9]


def test_a_line_is_traced_to_both_ends():
    points = np.array([[column, 5] for column in range(50)])
    directions = np.full((10, 50, 2), -1)
    directions[5] = [0, 18]
    for start in (0, 25, 49):
        found = trace(points, directions, start, VectorizeConfig(jump_px=10))
        assert (np.abs(np.diff(found[:, 0])) == 7).all()
        assert found[:, 0].min() < 7
        assert found[:, 0].max() > 42


def test_lines_in_metres_are_elements():
    lines = [TracedLine(np.array([[0, 0], [10, 4]]), 1, 0.75), TracedLine(np.array([[3, 3]]), 0, 1)]
    elements = elements_of_lines(lines, first_m=(-30.0, 15.0), pixel_m=(0.5, -0.25))
    np.testing.assert_allclose(elements.points, [[-30, 15], [-25, 14]])
    assert elements.labels.tolist() == [1]
    assert elements.scores.tolist() == [0.75]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s, e, d: (s[:, 1:], e, d), "must be .channels, H, W. of one size"),
        (lambda s, e, d: (s[0], e, d), "must be .channels, H, W. of one size"),
        (lambda s, e, d: (s[:1], e, d), "at least one class"),
        (lambda s, e, d: (s, e, d[:20]), "no full circle in steps of 10 degrees"),
        (lambda s, e, d: (s / 0, e, d), "^semantic have values that are not finite"),
        (lambda s, e, d: (s, e * np.nan, d / 0), "^embedding and direction have values"),
    ],
)
def test_maps_that_do_not_fit_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        vectorize(*change(*maps()))


@pytest.mark.parametrize(
    "name", ["eps", "min_neighbours", "ridge_tolerance", "step_px", "jump_px", "degrees"]
)
@pytest.mark.parametrize("value", [0, np.nan])
def test_settings_are_checked(name, value):
    with pytest.raises(ValueError, match=f"{name} must be more than 0"):
        VectorizeConfig(**{name: value})
    with pytest.raises(ValueError, match="min_area_px must not be negative, got -1"):
        VectorizeConfig(min_area_px=-1)
    release = VectorizeConfig()
    values = release.min_area_px, release.eps, release.min_neighbours, release.ridge_tolerance
    assert (*values, release.step_px, release.jump_px, release.degrees) == (
        100, 1.5, 50, 1e-4, 7, 50, 10
    )  # fmt: skip
