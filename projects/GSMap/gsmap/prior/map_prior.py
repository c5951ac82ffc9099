"""Map prior: a raster of the map in the global frame, stored as square tiles."""

import mmap
import os
import threading
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsmap.prior.file_format import read_header, write_tiles
from gsmap.prior.inputs import Pose, Raster, planar_pose, reserve_file, to_numpy
from gsmap.prior.reads import PriorReads
from gsmap.prior.rules import HitMissCounts, States, WriteRule
from gsmap.prior.settings import PriorSettings
from gsmap.prior.sources import PriorSources
from gsmap.prior.tiles import TileStore
from gsmap.prior.vectors import covered_cells
from gsmap.structures.elements import MapElements
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError
from gsmap.utils.files import atomic_write
from gsmap.utils.inputs import forget_input

MEMORY_BYTES = 100 << 20
"""Default of ``memory_bytes``, the largest total size of the tiles in memory."""
# Limit of the extent of a frame: a square with a side from the frame's origin to its farthest edge
# may have this number of the prior's cells. `_window` checks it.
_MOST_CELLS = 1 << 24


class MapPrior:
    """Raster of the map at places that a vehicle has passed, with one channel per class.

    The raster consists of square tiles. A tile is created when a frame is first written to it. If
    the tiles need more than ``memory_bytes``, the least recently used ones are moved from memory to
    a temporary file. All methods may be called from several threads.

    A frame has a grid with cells of any size. `read` and `write` use, for each cell of the grid,
    the cell of the prior in which the centre of the grid's cell lies. For a centre (x, y) in the
    global frame, the cell of the prior has the index floor(x / cell_m) along x and
    floor(y / cell_m) along y. Only the position and the yaw of a pose are used, as in
    `MapElements.to_frame`.

    Args:
        settings: Classes, place (name of the global frame), cells and tiles.
        rule: Rule of writing: it updates the stored numbers of a cell by a prediction, and converts
            them to the value that `read` returns. By default, `HitMissCounts`. `LastSeen` and
            `KeepMaximum` are the rules of HRMapNet (arXiv 2409.00620).
        memory_bytes: Largest total size of the tiles in memory. A tile of three classes takes
            120 kB, or 240 kB with `HitMissCounts`.

    Attributes:
        reads: Samples at which a model has read this prior.
        sources: Samples that this prior was made of, added by the code that writes them.
    """

    def __init__(
        self,
        settings: PriorSettings,
        rule: WriteRule | None = None,
        memory_bytes: int = MEMORY_BYTES,
    ) -> None:
        self.settings = settings
        self.rule: WriteRule = HitMissCounts() if rule is None else rule
        self.reads = PriorReads()
        self.sources = PriorSources()
        side = settings.tile_cells
        num_classes = len(settings.classes)
        tile_shape = (self.rule.num_states, num_classes, side, side)
        self._tiles = TileStore(tile_shape, memory_bytes=memory_bytes)
        self._lock = threading.RLock()
        # Open lock file that reserves the file `_owned_path` until it is closed.
        self._owner: IO[str] | None = None
        self._owned_path: Path | None = None

    @classmethod
    def load(
        cls,
        path: str | Path,
        settings: PriorSettings | None = None,
        update: bool = False,
        memory_bytes: int = MEMORY_BYTES,
    ) -> "MapPrior":
        """Open a file that `save` has written. Tiles are read when they are needed.

        Args:
            path: File of the prior. It may be untrusted.
            settings: Classes, place and cells that the file must have; None to accept any.
            update: Reserve the file for this process until `close`, to save it later. Another
                process can still read it.
            memory_bytes: Largest total size of the tiles in memory.

        Returns:
            The prior, which keeps the file open until `close`.

        Raises:
            FileNotFoundError: If the file does not exist.
            ValueError: If the file is no valid prior, or has other settings.
            RuntimeError: If the file is reserved by another process, or by another prior in this
                process.
        """
        path = Path(path)
        # Open lock file of the reservation.
        owner = reserve_file(path) if update else None
        # After an error, the file is closed and its reservation ends.
        try:
            mapped = _map_file(path)
            try:
                header = read_header(mapped, path)
                if settings is not None:
                    settings.require_equal(header.settings, str(path))
            except BaseException:
                mapped.close()
                raise
        except BaseException:
            if owner is not None:
                owner.close()
            raise
        prior = cls(header.settings, header.rule, memory_bytes=memory_bytes)
        prior.sources = header.sources
        prior._tiles.open(mapped, path=path, entries=header.entries)
        prior._owner = owner
        prior._owned_path = path.resolve() if update else None
        return prior

    def save(self, path: str | Path) -> None:
        """Write the prior to a file, which replaces ``path`` when it is complete.

        Args:
            path: File to create or replace.

        Raises:
            RuntimeError: If the file is reserved by another process, or by another prior in this
                process.
            ValueError: If another program has written the lock file beside it, the file by which
                processes reserve ``path``.
        """
        path = Path(path)
        with self._lock:
            # A file that `load` has reserved for this prior must not be reserved a second time.
            is_reserved = self._owned_path == path.resolve()
            owner = None if is_reserved else reserve_file(path)
            if is_reserved:
                forget_input(path)
            try:
                with atomic_write(path, mode="wb") as file:
                    write_tiles(
                        file,
                        self.settings,
                        rule=self.rule,
                        tiles=self._tiles.packed_tiles(),
                        sources=self.sources,
                    )
                # From here on, tiles are read from the new file. If ``path`` is a device file or a
                # pipe, it cannot be read.
                if path.is_file():
                    mapped = _map_file(path)
                    header = read_header(mapped, path)
                    self._tiles.open(mapped, path, entries=header.entries)
            finally:
                if owner is not None:
                    owner.close()

    def close(self) -> None:
        """Release memory, and the file if it is reserved. Changes since `save` are lost."""
        with self._lock:
            self._tiles.close()
            if self._owner is not None:
                self._owner.close()
            self._owner = None
            self._owned_path = None

    def __enter__(self) -> "MapPrior":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    @property
    def num_tiles(self) -> int:
        """Number of all tiles, in memory or in a file."""
        with self._lock:
            return len(self._tiles.keys())

    @property
    def num_tiles_in_memory(self) -> int:
        """Number of tiles in memory."""
        return self._tiles.num_in_memory

    def read(self, pose: Pose, grid: BEVGrid) -> Tensor:
        """Read the prior at the cells of a frame.

        Args:
            pose: Transform from the frame of ``grid`` to the global frame, in metres. Far from the
                origin it must be float64. (4, 4)
            grid: Extent and cells of the frame, H rows and W columns.

        Returns:
            Values of the C classes in [0, 1], 0 where nothing has been written. They are float32 on
            the device of ``pose``. (C, H, W)

        Raises:
            ValueError: If ``pose`` is no rigid transform or too far from the origin, or the grid is
                too large.
        """
        window = self._window(pose, grid)
        with self._lock:
            canvas = self._load_canvas(window)
        flat_canvas = _flatten_cells(canvas)
        # The rule stores S numbers (states) for each class of a cell, and converts them to values.
        states = flat_canvas[..., window.cells]  # (S, C, H * W)
        values = self.rule.read(states).reshape(-1, grid.height, grid.width)
        device = pose.device if isinstance(pose, Tensor) else torch.device("cpu")
        return torch.from_numpy(values).to(device)

    def write(
        self, pose: Pose, grid: BEVGrid, values: Raster, visible: Raster | None = None
    ) -> None:
        """Write the prediction of a frame.

        If several cells of the frame lie in a cell of the prior, the largest prediction counts.

        Args:
            pose: Transform from the frame of ``grid`` to the global frame, in metres. Far from the
                origin it must be float64. (4, 4)
            grid: Extent and cells of the frame, H rows and W columns.
            values: Prediction of the C classes in [0, 1]; 0 is a miss. (C, H, W)
            visible: Whether a cell is in view and not occluded, bool; None if all are. Other cells
                do not change. (H, W)

        Raises:
            ValueError: If a shape is wrong, a value is not in [0, 1], ``pose`` is no rigid
                transform or too far from the origin, or the grid is too large.
        """
        size = (grid.height, grid.width)
        prediction = to_numpy(values).astype(np.float32, copy=False)
        expected = (len(self.settings.classes), *size)
        if prediction.shape != expected:
            raise InputError(f"values must have shape {expected}, got {prediction.shape}.")
        if not (prediction.min() >= 0 and prediction.max() <= 1):  # also refuses NaN
            raise InputError("values must be in [0, 1].")
        in_view = np.ones(size, dtype=np.bool_) if visible is None else to_numpy(visible)
        if in_view.shape != size or in_view.dtype != np.bool_:
            raise InputError(
                f"visible must be bool of shape {size}, got {in_view.dtype} of shape "
                f"{in_view.shape}."
            )
        window = self._window(pose, grid)
        flat_values = prediction.reshape(len(prediction), -1)
        cells = window.cells
        if visible is not None:
            indices_in_view = np.flatnonzero(in_view)
            cells = cells[indices_in_view]
            flat_values = flat_values[:, indices_in_view]
        # Cells of the prior that are written, and their values.
        touched, largest = _largest_per_cell(cells, flat_values, size=window.height * window.width)
        with self._lock:
            canvas = self._load_canvas(window)
            flat_canvas = _flatten_cells(canvas)  # a view, so that `canvas` is updated
            flat_canvas[..., touched] = self.rule.update(
                states=flat_canvas[..., touched], values=largest
            )
            self._store_canvas(window, canvas=canvas, touched=touched)

    def write_map(self, elements: MapElements, width_m: float = 0.6) -> None:
        """Write the lines and areas of a vector map.

        Each cell that they cover is updated by a prediction of 1, and other cells do not change.
        Closed elements of area classes, such as crossings, are filled.

        Args:
            elements: Map in the global frame, in metres, with the classes of the prior.
            width_m: Width of a line in metres, > 0. A narrower line is drawn as wide as a cell.

        Raises:
            ValueError: If a label or a vertex is out of range, the map is too large, or ``width_m``
                is not in (0, 10].
        """
        if not 0 < width_m <= 10:
            raise InputError(f"width_m must be in (0, 10], got {width_m}.")
        # For each tile, a mask of the cells that each class covers. (C, tile_cells, tile_cells)
        for key, covered in covered_cells(elements, settings=self.settings, width_m=width_m):
            with self._lock:
                tile = self._tiles.get_to_write(key, empty=self.rule.empty)
                for channel, mask in enumerate(covered):
                    # A rule updates states (S, C, n) of n cells. Here C is 1, since the cells
                    # differ from class to class.
                    states = tile[:, channel, mask][:, None]
                    hits = np.ones(states.shape[1:], dtype=np.float32)
                    updated = self.rule.update(states=states, values=hits)
                    tile[:, channel, mask] = updated[:, 0]

    def _window(self, pose: Pose, grid: BEVGrid) -> "_Window":
        """Find the rectangle of the prior's cells around a frame, and the frame's cells in it.

        Raises:
            ValueError: If ``pose`` is no rigid transform or too far from the origin, or the grid is
                too large.
        """
        frame = planar_pose(pose)
        cos = frame.cos
        sin = frame.sin
        dx, dy = grid.pixel_size_m
        x = grid.x_range[0] + dx * (np.arange(grid.width) + 0.5)  # (W,)
        y = grid.y_range[0] + dy * (np.arange(grid.height) + 0.5)  # (H,)
        # The grid lies in a square around the origin of the frame, which reaches corner_m to each
        # side. The square consists of four squares of side corner_m, which may each have
        # _MOST_CELLS cells of the prior.
        corner_m = max(map(abs, (*grid.x_range, *grid.y_range)))
        square_cells = (2 * corner_m / self.settings.cell_m) ** 2
        if not square_cells <= 4 * _MOST_CELLS:  # also refuses NaN
            raise InputError(
                f"the grid reaches {corner_m:g} m, too far for cells of {self.settings.cell_m:g} m."
            )
        # Centres of the frame's cells in the global frame.
        global_x = (cos * x + frame.x_m) - sin * y[:, None]  # (H, W)
        global_y = (sin * x + frame.y_m) + cos * y[:, None]
        columns = np.floor(global_x / self.settings.cell_m).astype(np.int64)
        rows = np.floor(global_y / self.settings.cell_m).astype(np.int64)
        first_column = int(columns.min())
        first_row = int(rows.min())
        width = int(columns.max()) - first_column + 1
        height = int(rows.max()) - first_row + 1
        cells = (rows - first_row) * width + (columns - first_column)
        return _Window(
            first_column=first_column,
            first_row=first_row,
            width=width,
            height=height,
            cells=cells.ravel(),
        )

    def _load_canvas(self, window: "_Window") -> States:
        """Copy the tiles of a window to one raster (canvas). (S, C, height, width)

        Where a tile is missing, the canvas has the empty state of the rule.
        """
        num_states, num_classes = self._tiles.shape[:2]
        shape = (num_states, num_classes, window.height, window.width)
        canvas = np.full(shape, self.rule.empty, dtype=np.uint8)
        for part in window.parts(self.settings.tile_cells):
            tile = self._tiles.get(part.key)
            if tile is not None:
                canvas[:, :, part.rows, part.columns] = tile[
                    :, :, part.tile_rows, part.tile_columns
                ]
        return canvas

    def _store_canvas(self, window: "_Window", canvas: States, touched: NDArray[np.int64]) -> None:
        """Copy a canvas back to the tiles in which at least one cell was touched (written)."""
        is_touched = np.zeros(window.height * window.width, dtype=np.bool_)
        is_touched[touched] = True
        is_touched = is_touched.reshape(window.height, window.width)
        for part in window.parts(self.settings.tile_cells):
            if is_touched[part.rows, part.columns].any():
                tile = self._tiles.get_to_write(part.key, empty=self.rule.empty)
                tile[:, :, part.tile_rows, part.tile_columns] = canvas[
                    :, :, part.rows, part.columns
                ]


@dataclass(frozen=True)
class _Part:
    """Part of a window in one tile.

    Attributes:
        key: Column and row of the tile.
        columns: Columns of the part in the window.
        rows: Rows of the part in the window.
        tile_columns: Columns of the part in the tile.
        tile_rows: Rows of the part in the tile.
    """

    key: tuple[int, int]
    columns: slice
    rows: slice
    tile_columns: slice
    tile_rows: slice


@dataclass(frozen=True)
class _Window:
    """Rectangle of the prior's cells that covers the grid of a frame.

    Args:
        first_column: Smallest column of the cells, counted from the origin of the global frame.
        first_row: Smallest row, counted in this way.
        width: Number of columns.
        height: Number of rows.
        cells: Cell of the prior for each cell of the frame, in the order of the frame's rows. It is
            an index into the rectangle, whose cells are counted row by row. (H * W,)
    """

    first_column: int
    first_row: int
    width: int
    height: int
    cells: NDArray[np.int64]

    def parts(self, side: int) -> list[_Part]:
        """Cut the rectangle at the borders of tiles of ``side`` cells."""
        parts = []
        row_cuts = _cuts(first=self.first_row, length=self.height, side=side)
        column_cuts = _cuts(first=self.first_column, length=self.width, side=side)
        for tile_row, rows, tile_rows in row_cuts:
            for tile_column, columns, tile_columns in column_cuts:
                part = _Part(
                    key=(tile_column, tile_row),
                    columns=columns,
                    rows=rows,
                    tile_columns=tile_columns,
                    tile_rows=tile_rows,
                )
                parts.append(part)
        return parts


def _cuts(first: int, length: int, side: int) -> list[tuple[int, slice, slice]]:
    """Cut a range at multiples of ``side``, the borders of tiles.

    Args:
        first: First cell of the range.
        length: Number of cells in the range.
        side: Number of cells of a tile.

    Returns:
        For each tile its index, the slice of its cells in the range, and their slice in the tile.
    """
    cuts = []
    end = first + length
    for tile in range(first // side, (end - 1) // side + 1):
        start = max(first, tile * side)
        stop = min(end, (tile + 1) * side)
        in_range = slice(start - first, stop - first)
        in_tile = slice(start - tile * side, stop - tile * side)
        cuts.append((tile, in_range, in_tile))
    return cuts


def _largest_per_cell(
    cells: NDArray[np.int64], values: NDArray[np.float32], size: int
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Compute, for each cell of the prior, the largest value of the frame's cells in it.

    Args:
        cells: Cell of the prior in which each cell of the frame lies, as an index into the window,
            in [0, size). (n,)
        values: Prediction in each cell of the frame, in [0, 1]. (C, n)
        size: Number of cells of the window.

    Returns:
        Cells of the prior in which a cell of the frame lies, ascending (m,), and the largest value
        in each (C, m).
    """
    is_touched = np.zeros(size, dtype=np.bool_)
    is_touched[cells] = True
    touched = np.flatnonzero(is_touched)
    # Maximum for all cells of the window. Values are >= 0, so the zeros do not change a maximum.
    # `scatter_reduce_` of torch takes the maximum of all values that have one index.
    largest = torch.zeros(len(values), size)
    index = torch.from_numpy(cells)
    for channel, channel_values in zip(largest, values, strict=True):
        channel.scatter_reduce_(0, index, torch.from_numpy(channel_values), reduce="amax")
    return touched, largest.numpy()[:, touched]


def _flatten_cells(canvas: States) -> States:
    """View of a canvas with its rows and columns in one axis. (S, C, h, w) -> (S, C, h * w)"""
    num_states, num_classes, height, width = canvas.shape
    return canvas.reshape(num_states, num_classes, height * width)


def _map_file(path: Path) -> mmap.mmap:
    """Map a file into memory for reading; an empty file is an error."""
    with path.open("rb") as file:
        if not os.fstat(file.fileno()).st_size:
            raise InputError(f"{path} is empty: copy or build it again.")
        return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
