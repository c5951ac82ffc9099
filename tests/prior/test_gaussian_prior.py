"""Gaussians of earlier drives: their update by hand and by a twin, masks, files."""

import os
import struct
import threading
import zlib

import numpy as np
import pytest
import shapely
import torch

from gsmap.prior import GaussianPrior, GaussianRule, MapPrior, PriorSettings
from gsmap.prior.file_format import _FOOTER, GAUSSIAN_MAGIC, read_header, write_tiles
from gsmap.prior.gaussian_prior import _STORED, _pack
from gsmap.prior.gaussian_updates import measure, sample_lines
from gsmap.prior.inputs import planar_pose
from gsmap.structures.elements import MapElements
from gsmap.structures.gaussians import Gaussians, covariances, fuse_gaussians
from gsmap.structures.grid import BEVGrid

SETTINGS = PriorSettings(("divider", "boundary"), "town")
GRID = BEVGrid((-15, 15), (-30, 30), 200, 100)
PLAIN = GaussianRule(decay=1.0, least_sigma_m=0.001)


def pose_at(x=0.0, y=0.0, yaw_rad=0.0):
    pose = torch.eye(4, dtype=torch.float64)
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    pose[:2, :2] = torch.tensor([[cos, -sin], [sin, cos]])
    pose[0, 3], pose[1, 3] = x, y
    return pose


def line_at(x, score=1.0, length_m=10.0, sigma_m=None, label=0):
    """A line ahead at an x of the frame, with Gaussians of one width."""
    points = np.array([[x, -length_m / 2], [x, length_m / 2]])
    scales = None if sigma_m is None else [np.full((2, 2), [sigma_m, 3.0])]
    rotations = None if sigma_m is None else [np.zeros(2)]
    return MapElements.from_polylines([points], [label], [score], scales, rotations)


def across_variance(distance_m, sigma_m):
    """Variance of a vertex at a distance from the vehicle. (...)"""
    return sigma_m**2 + (0.02 * distance_m) ** 2


def test_two_lines_make_their_weighted_mean_by_hand():
    """Lines at x = 0 and 0.3 m, with variances 0.04 and 0.01 + (0.02 * 0.3)^2 = 0.010036.

    The mean is 0.3 * 0.04 / 0.050036, the variance 0.04 * 0.010036 / 0.050036.
    """
    prior = GaussianPrior(SETTINGS, PLAIN)
    prior.write(pose_at(), GRID, line_at(0.0, sigma_m=0.2))
    prior.write(pose_at(), GRID, line_at(0.3, sigma_m=0.1))
    means, found, values = prior.gaussians(0)
    assert len(means) == 11  # one a metre
    middle = np.abs(means[:, 1]).argmin()
    assert means[middle] == pytest.approx([0.2398273, 0.0], abs=1e-5)  # float32 within a tile
    expected = np.diag([0.00802302, 0.25])  # along the line: half of the spacing
    np.testing.assert_allclose(found[middle], expected, atol=1e-6)
    np.testing.assert_allclose(values, 2 / 2.25, rtol=1e-6)  # two hits and the pseudo-count
    assert prior.gaussians(1)[0].shape == (0, 2)


@pytest.mark.parametrize("place", [(0.0, 0.0), (-59.9, 120.1), (999_990.0, -1_000_003.0)])
def test_updates_are_those_of_a_filter_in_information_form(place):
    """A twin multiplies whole Gaussians, with a matrix of information for each measurement."""
    rule = GaussianRule(decay=0.8, least_sigma_m=0.001)
    prior = GaussianPrior(SETTINGS, rule)
    rng = np.random.default_rng(0)
    yaw_rad = 0.7
    pose = pose_at(*place, yaw_rad)
    offsets = rng.normal(0, 0.3, 6)
    sigmas = rng.uniform(0.1, 0.4, 6)
    along = np.arange(-5.0, 5.1)
    normal = np.array([np.cos(yaw_rad), np.sin(yaw_rad)])
    tangent = np.array([-normal[1], normal[0]])
    state = None
    for offset, sigma in zip(offsets, sigmas, strict=True):
        prior.write(pose, GRID, line_at(offset, sigma_m=sigma))
        centres = offset * normal + along[:, None] * tangent
        variances = across_variance(np.hypot(offset, along), sigma)
        if state is None:
            state = []
            for centre, variance in zip(centres, variances, strict=True):
                covariance = variance * np.outer(normal, normal) + 0.25 * np.outer(tangent, tangent)
                state.append((centre, covariance))
            continue
        for index, (mean, covariance) in enumerate(state):
            information = np.linalg.inv(covariance)
            older = normal @ information @ normal
            information -= (1 - rule.decay) * older * np.outer(normal, normal)
            gained = np.outer(normal, normal) / variances[index]
            new_covariance = np.linalg.inv(information + gained)
            new_mean = new_covariance @ (information @ mean + gained @ centres[index])
            state[index] = (new_mean, new_covariance)
    means, found, _ = prior.gaussians(0)
    order = np.argsort((means - np.array(place)) @ tangent)
    assert len(order) == len(state)
    for index, (mean, covariance) in zip(order, state, strict=True):
        # positions are float32 within a tile; the variance is interpolated between both points
        np.testing.assert_allclose(means[index] - np.array(place), mean, atol=2e-3)
        np.testing.assert_allclose(found[index], covariance, atol=2e-4)


def test_an_update_is_the_product_of_gaussians():
    """With a wide measurement along the line, as `fuse_gaussians` multiplies."""
    prior = GaussianPrior(SETTINGS, PLAIN)
    prior.write(pose_at(), GRID, line_at(0.0, sigma_m=0.2))
    prior.write(pose_at(), GRID, line_at(0.4, sigma_m=0.3))
    both = []
    for x, sigma in ((0.0, 0.2), (0.4, 0.3)):
        along = 0.5 if x == 0 else 1e4
        scales = torch.tensor([[along, sigma]], dtype=torch.float64)
        turn = torch.tensor([np.pi / 2], dtype=torch.float64)
        both.append(Gaussians(torch.tensor([[x, 0.0]], dtype=torch.float64), scales, turn))
    product = fuse_gaussians(*both)
    means, found, _ = prior.gaussians(0)
    middle = np.abs(means[:, 1]).argmin()
    np.testing.assert_allclose(means[middle], product.means[0], atol=2e-4)
    np.testing.assert_allclose(found[middle], covariances(product)[0], atol=2e-5)


def test_measurements_are_those_of_a_search_over_all_lines():
    """A twin cuts each normal with each segment."""
    rng = np.random.default_rng(1)
    lines = [np.cumsum(rng.normal([1.0, 0.5], 2, (6, 2)), axis=0) for _ in range(8)]
    elements = MapElements.from_polylines(lines, [0] * 8, rng.uniform(0.3, 1, 8))
    rule = GaussianRule()
    samples = sample_lines(elements, 0, planar_pose(np.eye(4)), rule)
    means = rng.uniform(-2, 12, (200, 2))
    angles = rng.uniform(-np.pi, np.pi, 200)
    found = measure(means, angles, samples)
    segments = [samples.points[[start, start + 1]] for start in samples.starts]
    for index, (mean, angle) in enumerate(zip(means, angles, strict=True)):
        normal = np.array([-np.sin(angle), np.cos(angle)])
        ray = shapely.LineString([mean - 1.5 * normal, mean + 1.5 * normal])
        best = None
        for segment in segments:
            step = np.diff(segment, axis=0)[0]
            cosine = abs(step @ [np.cos(angle), np.sin(angle)]) / np.linalg.norm(step)
            cut = ray.intersection(shapely.LineString(segment))
            if cosine >= np.cos(np.radians(30)) and not cut.is_empty:
                distance = (np.array(cut.coords[0]) - mean) @ normal
                if best is None or abs(distance) < abs(best):
                    best = distance
        assert found.is_found[index] == (best is not None)
        if best is not None:
            assert found.distances[index] == pytest.approx(best, abs=1e-6)
    assert found.is_found.sum() > 20


def test_a_line_that_is_gone_fades_where_it_is_in_view():
    prior = GaussianPrior(SETTINGS)
    prior.write(pose_at(), GRID, line_at(0.0, length_m=100.0))
    first = prior.num_gaussians
    empty = MapElements.from_polylines()
    hidden = np.ones((200, 100), dtype=np.bool_)
    hidden[100:] = False  # ahead
    prior.write(pose_at(), GRID, empty, visible=hidden)
    means, _, values = prior.gaussians(0)
    is_in_view = (means[:, 1] >= -30) & (means[:, 1] < 0)
    np.testing.assert_allclose(values[~is_in_view], 0.8, rtol=1e-6)
    np.testing.assert_allclose(values[is_in_view], 0.95 / (0.95 + 1 + 0.25), rtol=1e-6)
    for _ in range(40):
        prior.write(pose_at(), GRID, empty)
    means, _, _ = prior.gaussians(0)
    assert np.abs(means[:, 1]).min() >= 30
    assert len(means) == first - 60


def test_lines_grow_and_do_not_double():
    prior = GaussianPrior(SETTINGS)
    rng = np.random.default_rng(0)
    for y in range(0, 200, 5):
        noise = rng.normal(0, 0.2)
        prior.write(pose_at(0, y), GRID, line_at(noise, 0.8, length_m=60.0))
    means, found, values = prior.gaussians(0)
    along = np.sort(means[:, 1])
    assert along[0] == pytest.approx(-30, abs=1)
    assert along[-1] == pytest.approx(225, abs=1)
    steps = np.diff(along)
    assert steps.min() > 0.4
    assert steps.max() < 1.8
    inner = (means[:, 1] > 0) & (means[:, 1] < 190)
    assert np.abs(means[inner, 0]).max() < 0.25
    assert np.median(found[inner, 0, 0]) < 0.12**2
    assert (found[inner, 0, 0] < 0.2**2).all()
    assert (values[inner] > 0.7).all()


def test_a_crossing_line_is_another_one():
    prior = GaussianPrior(SETTINGS)
    prior.write(pose_at(), GRID, line_at(0.0))
    prior.write(pose_at(yaw_rad=np.pi / 2), GRID, line_at(0.0))
    means, _, _ = prior.gaussians(0)
    assert len(means) == 22


def test_masks_have_the_values_of_their_gaussians():
    """A piece of 1 m at x = 0: its two Gaussians, half a metre before and behind the origin."""
    rule = GaussianRule(line_sigma_m=0.3)
    prior = GaussianPrior(SETTINGS, rule)
    prior.write(pose_at(100, -60), GRID, line_at(0.0, length_m=1.0, sigma_m=0.4))
    grid = BEVGrid((-3, 3), (-3, 3), 61, 61)
    masks = prior.read_masks(pose_at(100, -60), grid)
    torch.testing.assert_close(prior.read(pose_at(100, -60), grid), masks.mean)
    assert masks.mean.shape == masks.spread.shape == (2, 61, 61)
    assert not masks.mean[1].any()
    x = grid.pixel_centres(dtype=torch.float64)[..., 0]
    y = grid.pixel_centres(dtype=torch.float64)[..., 1]
    for mask, sigma in zip(masks, (0.3, (0.3**2 + 0.4**2 + 1e-4) ** 0.5), strict=True):
        free = torch.ones(61, 61, dtype=torch.float64)
        for centre in (-0.5, 0.5):
            free *= 1 - torch.exp(-0.5 * ((x / sigma) ** 2 + ((y - centre) / 0.5) ** 2))
        torch.testing.assert_close(mask[0].double(), 1 - free, atol=1e-4, rtol=0)
    turned = prior.read(pose_at(100, -60, np.pi / 2), grid)[0]
    torch.testing.assert_close(turned, masks.mean[0].T.flip(1), atol=1e-4, rtol=0)
    assert not prior.read(pose_at(5000, 0), grid).any()


def test_weak_gaussians_are_not_drawn():
    prior = GaussianPrior(SETTINGS)
    prior.write(pose_at(), GRID, line_at(0.0, score=0.4))  # 0.4 / 1.25
    assert not prior.read(pose_at(), GRID).any()
    prior.write(pose_at(), GRID, line_at(0.0, score=0.9))
    assert prior.read(pose_at(), GRID)[0].max() > 0.8


def test_threads_write_as_one_after_another():
    prior = GaussianPrior(SETTINGS)
    places = np.arange(8) * 200.0

    def work(x):
        for _ in range(3):
            prior.write(pose_at(x), GRID, line_at(0.0, length_m=20))
            prior.read(pose_at(x), GRID)

    threads = [threading.Thread(target=work, args=(x,)) for x in places]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert prior.num_gaussians == 8 * 21
    _, _, values = prior.gaussians(0)
    assert np.unique(values.round(6)).size == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda: {"elements": line_at(0.0, label=2)}, r"labels of elements must be in \[0, 2\)"),
        (lambda: {"visible": np.ones((3, 3), dtype=np.bool_)}, "visible must be bool of shape"),
        (lambda: {"visible": np.ones((200, 100))}, "visible must be bool of shape"),
        (lambda: {"pose": torch.zeros(4, 4)}, "pose must be a rigid transform"),
        (lambda: {"pose": pose_at(1e9)}, r"pose is 1e\+09 m from the origin"),
    ],
)
def test_wrong_frames_are_refused(change, message):
    prior = GaussianPrior(SETTINGS)
    words = {"pose": pose_at(), "grid": GRID, "elements": line_at(0.0), **change()}
    with pytest.raises(ValueError, match=message):
        prior.write(**words)
    assert prior.num_gaussians == 0


@pytest.mark.parametrize(
    "name", ["spacing_m", "sigma_m", "least_sigma_m", "line_sigma_m", "decay", "prior_count"]
)
@pytest.mark.parametrize("value", [-1.0, 1e9, float("nan")])
def test_settings_out_of_range_are_named(name, value):
    with pytest.raises(ValueError, match=rf"{name} must be in \["):
        GaussianRule(**{name: value})


def filled():
    prior = GaussianPrior(SETTINGS, GaussianRule(decay=0.9))
    for x in (-400, -60, 0, 130):
        prior.write(pose_at(x), GRID, line_at(1.0, 0.7))
        prior.write(pose_at(x), GRID, line_at(1.2, 0.7, label=1))
    return prior


def test_a_file_holds_everything(tmp_path):
    prior = filled()
    path = tmp_path / "town.gaussians"
    prior.save(path)
    found = GaussianPrior.load(path, SETTINGS)
    assert found.rule == prior.rule
    assert found.settings == SETTINGS
    for label in (0, 1):
        for one, other in zip(prior.gaussians(label), found.gaussians(label), strict=True):
            np.testing.assert_array_equal(one, other)
    found.write(pose_at(), GRID, line_at(1.0))  # tiles of a file can be changed
    found.save(path)
    GaussianPrior(SETTINGS).save(path)
    assert GaussianPrior.load(path).num_gaussians == 0
    assert sorted(os.listdir(tmp_path)) == [".town.gaussians.lock", "town.gaussians"]


def test_what_is_saved_can_be_loaded(tmp_path, monkeypatch):
    """A vertex a rounding before the edge of a tile, a wide line, and a crowded tile."""
    path = tmp_path / "town.gaussians"
    settings = PriorSettings(("divider",), "town", cell_m=0.1, tile_m=0.7)
    edges = 0.7 * np.arange(1, 40)
    before = np.nextafter(edges, -np.inf)
    assert (np.floor(before / 0.7) * 0.7 > before).any()  # the quotient is rounded up
    prior = GaussianPrior(settings)
    for x in before:
        prior.write(pose_at(), GRID, line_at(x))
    prior.save(path)
    assert GaussianPrior.load(path).num_gaussians == prior.num_gaussians > 100
    prior = GaussianPrior(SETTINGS)
    prior.write(pose_at(), GRID, line_at(0.0, sigma_m=200.0))
    prior.save(path)
    _, found, _ = GaussianPrior.load(path).gaussians(0)
    assert found[:, 0, 0] == pytest.approx(1e4)
    monkeypatch.setattr("gsmap.prior.gaussian_prior._MOST_PER_TILE", 2)
    with pytest.raises(ValueError, match=r"a tile has 6 .*, and 2 are possible.* below 60 m"):
        prior.save(path)


def test_files_of_other_settings_and_kinds_are_refused(tmp_path):
    path = tmp_path / "town.gaussians"
    filled().save(path)
    with pytest.raises(ValueError, match=r"has place 'town', and 'city' is needed"):
        GaussianPrior.load(path, PriorSettings(("divider", "boundary"), "city"))
    with pytest.raises(ValueError, match=r"is no map prior: give a file that MapPrior\.save has"):
        MapPrior.load(path)
    MapPrior(SETTINGS).save(path)
    with pytest.raises(
        ValueError, match=r"no Gaussian prior: give a file that GaussianPrior\.save"
    ):
        GaussianPrior.load(path)


def rewritten(content, path, change=None, pack=_pack, rule=None):
    """The file with changed Gaussians and right checksums."""
    settings, found_rule, places, _ = read_header(content, path, magic=GAUSSIAN_MAGIC)
    tiles = []
    for key, (offset, length, _) in places.items():
        packed = zlib.decompress(content[offset + 4 : offset + length])
        stored = np.frombuffer(packed, dtype=_STORED).copy()
        if change is not None:
            change(stored)
        tiles.append((key, pack(stored)))
    with path.open("wb") as file:
        write_tiles(file, settings, rule or found_rule, tiles, magic=GAUSSIAN_MAGIC)


def set_value(name, value):
    def change(stored):
        stored[name][0] = value

    return change


def bomb(stored):
    return (4).to_bytes(4, "little") + zlib.compress(bytes(100_000_000))


def flipped(content, at):
    return content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :]


HOSTILE = {
    "nothing": (lambda c, p: p.write_bytes(b""), "is empty"),
    "text": (lambda c, p: p.write_bytes(b"<!doctype html>" * 20), "it is a web page"),
    "cut": (lambda c, p: p.write_bytes(c[:-5]), "is cut off"),
    "cut after its start": (lambda c, p: p.write_bytes(c[:20]), "is cut off"),
    "another version": (
        lambda c, p: p.write_bytes(c[:8] + struct.pack("<I", 9) + c[12:]), "has version 9",
    ),
    "a changed header": (lambda c, p: p.write_bytes(flipped(c, 30)), "a checksum is wrong"),
    "a changed tile": (lambda c, p: p.write_bytes(flipped(c, 400)), "a tile cannot be read"),
    "a changed index": (
        lambda c, p: p.write_bytes(flipped(c, len(c) - _FOOTER.size - 9)), "a checksum is wrong",
    ),
    "a NaN": (lambda c, p: rewritten(c, p, set_value("angle", np.nan)), "Gaussian is out of range"),
    "a far position": (
        lambda c, p: rewritten(c, p, set_value("position", (70.0, 0.0))), "out of range",
    ),
    "no variance": (lambda c, p: rewritten(c, p, set_value("variance", 0.0)), "out of range"),
    "an infinite variance": (
        lambda c, p: rewritten(c, p, set_value("variance", np.inf)), "out of range",
    ),
    "another class": (lambda c, p: rewritten(c, p, set_value("label", 2)), "out of range"),
    "negative counts": (lambda c, p: rewritten(c, p, set_value("hits", -1.0)), "out of range"),
    "infinite counts": (lambda c, p: rewritten(c, p, set_value("misses", np.inf)), "out of range"),
    "a bomb": (lambda c, p: rewritten(c, p, pack=bomb), "a tile cannot be read"),
    "a large number": (
        lambda c, p: rewritten(c, p, pack=lambda s: b"\xff" * 4 + _pack(s)[4:]), "cannot be read",
    ),
    "a short tile": (lambda c, p: rewritten(c, p, pack=lambda s: b"ab"), "cannot be read"),
}  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_end_in_one_line(tmp_path, name):
    make, message = HOSTILE[name]
    path = tmp_path / "town.gaussians"
    filled().save(path)
    make(path.read_bytes(), path)
    with pytest.raises(ValueError, match=message) as error:
        GaussianPrior.load(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)
