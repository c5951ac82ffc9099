"""Reading and writing of map priors, against values by hand and a twin that visits each cell."""

import math
import threading
from dataclasses import replace

import numpy as np
import pytest
import torch

from gsmap.prior import HitMissCounts, KeepMaximum, LastSeen, MapPrior, PriorSettings
from gsmap.structures.elements import MapElements
from gsmap.structures.grid import BEVGrid

SETTINGS = PriorSettings(("divider", "boundary", "ped_crossing"), "town")
GRID = BEVGrid((-15, 15), (-30, 30), 40, 20)  # 1.5 m: cells of the prior stay free between
RULES = [KeepMaximum(), LastSeen(), HitMissCounts(decay=15 / 16)]  # counts without rounding errors


def pose_at(x: float, y: float, yaw_rad: float = 0.0) -> torch.Tensor:
    pose = torch.eye(4, dtype=torch.float64)
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    pose[:2, :2] = torch.tensor([[cos, -sin], [sin, cos]])
    pose[0, 3], pose[1, 3] = x, y
    return pose


class Twin:
    """The prior as a dictionary of cells, which a loop over the cells of a frame visits."""

    def __init__(self, rule, cell_m=0.3):
        self.rule, self.cell_m, self.cells = rule, cell_m, {}

    def places(self, pose, grid):
        """Yield row and column of each cell of the frame, and its cell of the prior."""
        yaw = math.atan2(pose[1, 0], pose[0, 0])
        for i in range(grid.height):
            for j in range(grid.width):
                x = grid.x_range[0] + (j + 0.5) * grid.pixel_size_m[0]
                y = grid.y_range[0] + (i + 0.5) * grid.pixel_size_m[1]
                to_x = math.cos(yaw) * x - math.sin(yaw) * y + float(pose[0, 3])
                to_y = math.sin(yaw) * x + math.cos(yaw) * y + float(pose[1, 3])
                yield i, j, (math.floor(to_x / self.cell_m), math.floor(to_y / self.cell_m))

    def write(self, pose, grid, values, visible=None):
        seen = {}
        for i, j, cell in self.places(pose, grid):
            if visible is None or visible[i, j]:
                here = values[:, i, j].tolist()
                seen[cell] = list(map(max, here, seen.get(cell, here)))
        for cell, here in seen.items():
            old = self.cells.get(cell, [self.start()] * len(here))
            self.cells[cell] = [self.step(*pair) for pair in zip(old, here, strict=True)]

    def read(self, pose, grid):
        out = np.zeros((3, grid.height, grid.width))
        for i, j, cell in self.places(pose, grid):
            if cell in self.cells:
                out[:, i, j] = [self.value(state) for state in self.cells[cell]]
        return out

    def start(self):
        return {KeepMaximum: 0, LastSeen: 100, HitMissCounts: (0, 0)}[type(self.rule)]

    def step(self, old, p):
        if isinstance(self.rule, KeepMaximum):
            return max(old, int(np.float32(p) * np.float32(255)))
        if isinstance(self.rule, LastSeen):
            new = max(old, int(100 + 30 * p)) if p > 0 else max(old, 100) - 1
            return min(max(new, 2), 240)
        counts = []
        for count, part in zip(old, (p, 1 - p), strict=True):
            exact = count * 15 / 16 + 255 / 16 * part
            counts.append(math.floor(exact + 0.5) if part else math.floor(exact))
        return tuple(counts)

    def value(self, state):
        if isinstance(self.rule, KeepMaximum):
            return state / 255
        if isinstance(self.rule, LastSeen):
            return min(max((state - 100) / 30, 0), 1)
        return state[0] / (state[0] + state[1] + 0.25 * 255 / 16)


def random_values(rng, grid=GRID):
    """Predictions that are 0 in most cells, in sixteenths, which float32 holds."""
    values = rng.integers(1, 17, (3, grid.height, grid.width)) / 16
    return torch.from_numpy(values * (rng.random(values.shape) < 0.3))


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: type(rule).__name__)
@pytest.mark.parametrize(
    ("x", "y"), [(0.0, 0.0), (59.9, -60.1), (-3210.7, 1234.5), (1e6, -1e6)], ids=str
)
def test_reading_and_writing_equal_the_twin(rule, x, y):
    rng = np.random.default_rng(abs(int(x)))
    prior, twin = MapPrior(SETTINGS, rule), Twin(rule)
    close = BEVGrid((-6, 6), (-8, 8), 61, 43)  # cells of 0.26 x 0.28 m: some share one
    for index in range(12):
        grid = close if index % 2 else GRID
        pose = pose_at(x + rng.normal(), y + rng.normal(), rng.uniform(-4, 4))
        values = random_values(rng, grid)
        visible = None if index < 4 else rng.random((grid.height, grid.width)) < 0.8
        prior.write(pose, grid, values, visible)
        twin.write(pose, grid, values, visible)
        at = pose_at(x + rng.normal(), y + rng.normal(), rng.uniform(-4, 4))
        for where in (pose, at):
            found = prior.read(where, grid)
            assert found.shape == (3, grid.height, grid.width)
            assert found.dtype == torch.float32
            np.testing.assert_allclose(found, twin.read(where, grid), atol=1e-6)  # of float32
    assert float(found.max()) > 0.1


def test_a_cell_by_hand():
    """The cell at (0.45, -0.45) is column 1, row -2: from 0.3 to 0.6 and from -0.6 to -0.3."""
    grid = BEVGrid((-0.15, 0.15), (-0.15, 0.15), 1, 1)
    prior = MapPrior(SETTINGS, KeepMaximum())
    prior.write(pose_at(0.45, -0.45, 1.0), grid, torch.tensor([1.0, 0.0, 0.2]).view(3, 1, 1))
    expected = torch.tensor([1.0, 0.0, 51 / 255])
    for x, y in ((0.31, -0.31), (0.59, -0.59), (0.31, -0.59)):
        torch.testing.assert_close(prior.read(pose_at(x, y), grid).ravel(), expected)
    for x, y in ((0.29, -0.45), (0.61, -0.45), (0.45, -0.29), (0.45, -0.61)):
        assert prior.read(pose_at(x, y), grid).sum() == 0
    assert prior.num_tiles == 1


def test_cells_that_are_out_of_view_or_occluded_do_not_change():
    prior = MapPrior(SETTINGS, HitMissCounts())
    prior.write(pose_at(0, 0), GRID, torch.ones(3, 40, 20))
    before = prior.read(pose_at(0, 0), GRID)
    visible = torch.zeros(40, 20, dtype=torch.bool)
    visible[:10] = True
    prior.write(pose_at(0, 0), GRID, torch.zeros(3, 40, 20), visible)
    after = prior.read(pose_at(0, 0), GRID)
    assert bool((after[:, :10] < before[:, :10]).all())
    torch.testing.assert_close(after[:, 10:], before[:, 10:], rtol=0, atol=0)
    prior.write(pose_at(0, 0), GRID, torch.zeros(3, 40, 20), torch.zeros_like(visible))
    torch.testing.assert_close(prior.read(pose_at(0, 0), GRID), after, rtol=0, atol=0)


def test_tiles_leave_memory_and_come_back():
    rng = np.random.default_rng(3)
    small = MapPrior(SETTINGS, LastSeen(), memory_bytes=3 * 120_000)
    large = MapPrior(SETTINGS, LastSeen())
    for _ in range(3):
        for x in range(0, 1200, 60):
            values = random_values(rng)
            for prior in (small, large):
                prior.write(pose_at(x, -x), GRID, values)
    assert small.num_tiles_in_memory <= 3 < large.num_tiles_in_memory
    assert small.num_tiles == large.num_tiles
    for x in range(0, 1200, 60):
        at = pose_at(x, -x, 0.3)
        torch.testing.assert_close(small.read(at, GRID), large.read(at, GRID), rtol=0, atol=0)


def test_the_temporary_file_is_compacted(monkeypatch):
    monkeypatch.setattr("gsmap.prior.tiles._WASTED_BYTES", 1000)
    rng = np.random.default_rng(3)
    prior, twin = (
        MapPrior(SETTINGS, KeepMaximum(), memory_bytes=1),
        MapPrior(SETTINGS, KeepMaximum()),
    )
    written = 0
    for _ in range(6):
        for x in range(0, 300, 60):
            values = random_values(rng)
            prior.write(pose_at(x, 0), GRID, values)
            twin.write(pose_at(x, 0), GRID, values)
            written += 4 * 3000
    spill = prior._tiles._spill
    assert spill._end <= 2 * spill._used_bytes + 20_000 < written
    for x in range(0, 300, 60):
        at = pose_at(x, 0)
        torch.testing.assert_close(prior.read(at, GRID), twin.read(at, GRID), rtol=0, atol=0)


def test_reading_creates_no_tiles():
    prior = MapPrior(SETTINGS)
    assert prior.read(pose_at(0, 0), GRID).sum() == 0
    assert prior.num_tiles == 0
    prior.write(pose_at(30, 30), GRID, torch.zeros(3, 40, 20))  # (15, 0) to (45, 60)
    assert prior.num_tiles == 1


def test_threads_lose_nothing():
    """Eight threads write their own class rows at the same place; every hit is there."""
    prior = MapPrior(SETTINGS, KeepMaximum(), memory_bytes=1)
    failures = []

    def work(index):
        try:
            values = torch.zeros(3, 40, 20)
            values[:, index::8] = 1
            for x in (0, 60, 120, 180):
                prior.write(pose_at(x, 0), GRID, values)
                prior.read(pose_at(x, 0), GRID)
        except BaseException as error:
            failures.append(error)

    threads = [threading.Thread(target=work, args=(index,)) for index in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failures == []
    for x in (0, 60, 120, 180):
        assert bool((prior.read(pose_at(x, 0), GRID) == 1).all())


@pytest.mark.parametrize("cell_m", [0.3, 0.6, 1.0, 1.5, 4.0])
def test_a_line_has_no_gap_whatever_the_size_of_the_cells(cell_m):
    for phase in (0.0, 0.3, 0.5, 0.7):
        for direction in ([1.0, 0.0], [1.0, 0.02], [1.0, 0.4], [1.0, 1.0]):
            prior = MapPrior(replace(SETTINGS, cell_m=cell_m), KeepMaximum())
            start = np.array([0.1, phase * cell_m])
            line = np.stack([start, start + 24 * np.array(direction)])
            prior.write_map(MapElements.from_polylines([line], [0]))
            grid = BEVGrid((2.0, 22.0), (-15.0, 45.0), height=150, width=50)  # cells of 0.4 m
            found = prior.read(np.eye(4), grid)[0]  # (rows, columns) of one class
            assert bool((found > 0).any(dim=0).all())


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_arrays_are_inputs_as_well(kind):
    prior = MapPrior(SETTINGS, KeepMaximum())
    values = np.ones((3, 40, 20), kind)
    prior.write(np.eye(4, dtype=kind), GRID, values)
    assert bool((prior.read(np.eye(4, dtype=kind), GRID) == 1).all())
    prior.write(torch.eye(4), GRID, torch.ones(3, 40, 20, dtype=torch.bfloat16, requires_grad=True))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_results_are_on_the_device_of_the_pose():
    prior = MapPrior(SETTINGS, KeepMaximum())
    pose = pose_at(1, 2, 3).cuda()
    prior.write(pose, GRID, torch.ones(3, 40, 20).cuda())
    found = prior.read(pose, GRID)
    assert found.device == pose.device
    assert bool((found == 1).all())


NOT_RIGID = pose_at(0, 0) * 2
FAR = pose_at(1e9, 0)
NAN = pose_at(math.nan, 0)


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (NOT_RIGID, "rigid"), (NAN, "rigid"), (torch.eye(3), "rigid"), (FAR, "from the origin"),
    ],
)  # fmt: skip
def test_wrong_poses_are_refused(pose, message):
    prior = MapPrior(SETTINGS)
    with pytest.raises(ValueError, match=message):
        prior.read(pose, GRID)
    with pytest.raises(ValueError, match=message):
        prior.write(pose, GRID, torch.zeros(3, 40, 20))
    assert prior.num_tiles == 0


def test_tiles_whose_number_is_too_large_for_a_file_are_refused(tmp_path):
    prior = MapPrior(PriorSettings(("divider",), "town", cell_m=0.01, tile_m=0.01))
    grid = BEVGrid((-0.1, 0.1), (-0.1, 0.1), 2, 2)
    prior.write(pose_at(39_512_000, 0), grid, torch.ones(1, 2, 2))
    with pytest.raises(ValueError, match=r"tiles of 0.01 m are too small for this map"):
        prior.save(tmp_path / "town.prior")
    assert not (tmp_path / "town.prior").exists()


@pytest.mark.parametrize(
    ("values", "visible", "message"),
    [
        (torch.zeros(2, 40, 20), None, "values must have shape"),
        (torch.full((3, 40, 20), 1.5), None, r"values must be in \[0, 1\]"),
        (torch.full((3, 40, 20), math.nan), None, r"values must be in \[0, 1\]"),
        (torch.zeros(3, 40, 20), torch.ones(40, 20), "visible must be bool"),
        (torch.zeros(3, 40, 20), torch.ones(20, 40, dtype=torch.bool), "visible must be bool"),
    ],
)
def test_wrong_predictions_are_refused(values, visible, message):
    prior = MapPrior(SETTINGS)
    with pytest.raises(ValueError, match=message):
        prior.write(pose_at(0, 0), GRID, values, visible)
    assert prior.num_tiles == 0


def test_a_grid_that_is_too_large_is_refused():
    grid = BEVGrid((-1e5, 1e5), (-1e5, 1e5), 10, 10)
    with pytest.raises(ValueError, match="too far for cells"):
        MapPrior(SETTINGS).read(pose_at(0, 0), grid)


@pytest.mark.parametrize(
    "wrong",
    [
        {"classes": ()},
        {"classes": ("a", "a")},
        {"classes": ("a\n",)},
        {"classes": (1,)},
        {"place": ""},
        {"place": "x" * 201},
        {"cell_m": 0},
        {"cell_m": math.nan},
        {"cell_m": True},
        {"cell_m": "0.3"},
        {"tile_m": 60.1},
        {"tile_m": 1e9},
        {"tile_m": math.inf},
        {"tile_m": 0.1},
        {"cell_m": 0.1, "tile_m": 102.5},
    ],
    ids=str,
)
def test_wrong_settings_are_refused(wrong):
    with pytest.raises(ValueError, match="must be"):
        PriorSettings(**{"classes": ("a",), "place": "town", **wrong})


@pytest.mark.parametrize(
    ("cell_m", "tile_m", "cells"), [(0.1 + 0.2, 0.3, 1), (0.1, 102.4, 1024), (0.3, 60.0, 200)]
)
def test_a_tile_has_whole_cells_whatever_is_rounded(cell_m, tile_m, cells):
    assert PriorSettings(("a",), "town", cell_m=cell_m, tile_m=tile_m).tile_cells == cells
