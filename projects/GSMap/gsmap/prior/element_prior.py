"""Prior of elements: the merged lines and areas of earlier drives, in the global frame."""

import zlib
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
import shapely
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsmap.ops.polyline_raster import draw_polylines
from gsmap.prior.element_rule import ElementRule
from gsmap.prior.file_format import (
    ELEMENT_MAGIC,
    TileKey,
    read_file,
    save_file,
    unpack_tile,
)
from gsmap.prior.inputs import Pose, planar_pose
from gsmap.prior.reads import PriorReads
from gsmap.prior.settings import PriorSettings
from gsmap.prior.sources import PriorSources
from gsmap.structures.classes import AREA_CLASSES
from gsmap.structures.cutting import cut_to_range
from gsmap.structures.elements import FARTHEST_M, FloatArray, MapElements
from gsmap.structures.grid import BEVGrid
from gsmap.structures.polylines import is_closed, pad_lines
from gsmap.utils.errors import InputError

_MOST_ELEMENTS = 1_000_000
_MOST_VERTICES = 4_000_000  # of all elements together
# Limit for areas whose outline crosses itself: each crossing makes the repair slower.
_MOST_VERTICES_OF_CROSSED_AREA = 50
# A tile in a file consists of its counts and, compressed, its stored elements and their vertices.
_COUNTS = np.dtype([("elements", "<u4"), ("vertices", "<u4")])
_STORED = np.dtype([("label", "<u2"), ("score", "<f4"), ("num_vertices", "<u4")])
_VERTEX = np.dtype("<f8")


class _Bounds(NamedTuple):
    """Bounding boxes of elements.

    Attributes:
        low: Smallest x and y in metres. (N, 2)
        high: Largest x and y in metres. (N, 2)
    """

    low: FloatArray
    high: FloatArray


class ElementPrior:
    """Elements of the map of a place, each with a class and a confidence.

    The confidence of an element is its score: of the earlier frames in whose view it was, the share
    that found it. All elements are in memory. The prior does not change, so all methods may be
    called from several threads.

    Args:
        settings: Classes, place and tiles of the file; the size of cells is not used.
        elements: Lines and areas in the global frame, in metres. Heights are dropped, and an
            element without a score has a confidence of 1.
        rule: Standard deviation of the points, and width of the drawn lines; ``ElementRule()`` by
            default.

    Attributes:
        content: Word for the stored data in messages.
        reads: Samples at which a model has read this prior.
        sources: Samples that this prior was made of, added by the code that makes it.

    Raises:
        ValueError: If a label, a score or a vertex is out of range, an element has no length or
            fewer than two vertices, the outline of an area is long and crosses itself, or there are
            too many elements or vertices.
    """

    content: ClassVar[str] = "elements"

    def __init__(
        self, settings: PriorSettings, elements: MapElements, rule: ElementRule | None = None
    ) -> None:
        num_classes = len(settings.classes)
        labels = elements.labels
        if len(labels) and not 0 <= labels.min() <= labels.max() < num_classes:
            raise InputError(f"labels of elements must be in [0, {num_classes}).")
        if len(elements) > _MOST_ELEMENTS:
            raise InputError(f"a prior has at most {_MOST_ELEMENTS} elements: split the map.")
        if (elements.num_points < 2).any():
            raise InputError("elements of a prior need two vertices or more.")
        flat = elements.with_coordinates(2)
        if len(flat.points) > _MOST_VERTICES:
            raise InputError(f"a prior has at most {_MOST_VERTICES} vertices: split the map.")
        is_near = np.abs(flat.points) <= FARTHEST_M  # False for NaN
        if not is_near.all():
            raise InputError(f"vertices must be within {FARTHEST_M:g} m of the origin.")
        confidence = flat.confidence
        if not ((confidence >= 0) & (confidence <= 1)).all():
            raise InputError("scores of elements must be in [0, 1].")
        bounds = _bounds(flat)
        if (bounds.low == bounds.high).all(axis=1).any():
            raise InputError("elements of a prior need a length: all vertices of one are equal.")
        _check_areas(flat, settings.classes)
        self.settings = settings
        self.rule = ElementRule() if rule is None else rule
        self.elements = flat
        self.reads = PriorReads()
        self.sources = PriorSources()
        self._bounds = bounds

    @classmethod
    def load(cls, path: str | Path, settings: PriorSettings | None = None) -> "ElementPrior":
        """Read a file that `save` has written.

        Args:
            path: File of the prior. It may be untrusted.
            settings: Classes, place and tiles that the file must have; None to accept any.

        Raises:
            ValueError: If the file is no valid prior of elements, or has other settings.
        """
        path = Path(path)
        content, header = read_file(path, settings, magic=ELEMENT_MAGIC)
        polylines: list[FloatArray] = []
        labels: list[int] = []
        scores: list[float] = []
        num_vertices_left = _MOST_VERTICES
        # Position and checksum of each tile in `content`, the bytes of the whole file.
        for offset, length, crc in header.entries.values():
            packed = content[offset : offset + length]
            stored, lines = _unpack(packed, crc=crc, path=path, most_vertices=num_vertices_left)
            # The limit holds for all tiles together, so a damaged file cannot fill the memory.
            num_vertices_left -= int(stored["num_vertices"].sum(dtype=np.int64))
            polylines += lines
            labels += stored["label"].tolist()
            scores += stored["score"].tolist()
        try:
            elements = MapElements.from_polylines(polylines, labels=labels, scores=scores)
            prior = cls(header.settings, elements, header.rule)
        # The constructor raises an `InputError`, a ValueError, whose message lacks the path.
        except ValueError as error:
            text = str(error).rstrip(".")
            raise InputError(f"{path} is damaged: {text}; build it again.") from error
        prior.sources = header.sources
        return prior

    def save(self, path: str | Path) -> None:
        """Write the prior to a file, which replaces ``path`` when it is complete.

        Args:
            path: File to create or replace.

        Raises:
            RuntimeError: If the file is reserved by another process.
            ValueError: If the tiles of the settings are too small for the extent of the map.
        """
        tiles = self._packed_tiles()
        save_file(
            Path(path),
            self.settings,
            rule=self.rule,
            tiles=tiles,
            magic=ELEMENT_MAGIC,
            sources=self.sources,
        )

    def read_elements(self, pose: Pose, grid: BEVGrid) -> MapElements:
        """Read the elements in the range of a frame.

        Args:
            pose: Transform from the frame of ``grid`` to the global frame, in metres. Far from the
                origin it must be float64. (4, 4)
            grid: Extent of the frame.

        Returns:
            Parts of the elements in the range, (x, y) in metres in the frame, with confidences.

        Raises:
            ValueError: If ``pose`` is no rigid transform, too far from the origin, or without yaw.
        """
        frame = planar_pose(pose)  # position and yaw, without height, roll and pitch
        x0, x1 = grid.x_range
        y0, y1 = grid.y_range
        # Corners of the range in the global frame. (4, 2)
        corners = frame.to_global(np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]))
        # Along each axis, compare the bounding box of each element with the one of the range. Both
        # overlap if each begins before the other ends. (N, 2)
        starts_before = self._bounds.low <= corners.max(axis=0)
        ends_behind = self._bounds.high >= corners.min(axis=0)
        is_near = (starts_before & ends_behind).all(axis=1)
        nearby = self.elements.select(is_near)
        local = MapElements(
            points=frame.to_frame(nearby.points),
            offsets=nearby.offsets,
            labels=nearby.labels,
            scores=nearby.scores,
        )
        return cut_to_range(
            local, self.settings.classes, x_range=grid.x_range, y_range=grid.y_range
        )

    def read(self, pose: Pose, grid: BEVGrid) -> Tensor:
        """Draw the elements in the cells of a frame, as a raster like the one of `MapPrior.read`.

        Closed elements of `AREA_CLASSES` are filled. The value of a cell is the confidence of the
        element that covers it, times the covered share of the cell. If several elements of a class
        cover a cell, it has the largest of their values.

        Args:
            pose: Transform from the frame of ``grid`` to the global frame, in metres. Far from the
                origin it must be float64. (4, 4)
            grid: Extent and cells of the frame, H rows and W columns.

        Returns:
            Values in [0, 1], float32 on the device of ``pose``. (C, H, W)

        Raises:
            ValueError: If ``pose`` is no rigid transform, too far from the origin, or without yaw.
        """
        elements = self.read_elements(pose, grid)
        raster = torch.zeros(len(self.settings.classes), grid.height, grid.width)
        if len(elements):
            is_filled = []
            for line, label, _ in elements.rows:
                is_area = self.settings.classes[label] in AREA_CLASSES
                # A closed line of three vertices runs back and forth and has no area.
                is_filled.append(is_area and len(line) > 3 and is_closed(line))
            # Covered share of each cell, for each element. (N, H, W)
            masks = draw_polylines(
                # Shorter lines are padded with their last vertex, which draws nothing.
                torch.from_numpy(pad_lines(elements.polylines)).float(),
                grid,
                width_m=self.rule.line_width_m,
                filled=torch.tensor(is_filled),
            )
            values = masks * torch.from_numpy(elements.confidence).float()[:, None, None]
            for value, label in zip(values, elements.labels.tolist(), strict=True):
                raster[label] = torch.maximum(raster[label], value)
        return raster.to(pose.device) if isinstance(pose, Tensor) else raster

    def _packed_tiles(self) -> list[tuple[TileKey, bytes]]:
        """Group the elements by the tile of their first vertex, and compress each group."""
        rows_of_tile: dict[TileKey, list[int]] = defaultdict(list)
        first_vertices = self.elements.points[self.elements.offsets[:-1]]
        tiles = np.floor(first_vertices / self.settings.tile_m).astype(np.int64)
        # `row` is the index of an element; `column` and `tile_row` are the position of a tile.
        for row, (column, tile_row) in enumerate(tiles.tolist()):
            rows_of_tile[column, tile_row].append(row)
        packed = []
        # Sorted, so that equal maps give equal files.
        for key, rows in sorted(rows_of_tile.items()):
            packed.append((key, _pack(self.elements.select(np.array(rows)))))
        return packed


def _bounds(elements: MapElements) -> _Bounds:
    """Bounding boxes of elements, each with at least one vertex."""
    if not len(elements):
        return _Bounds(low=np.zeros((0, 2)), high=np.zeros((0, 2)))
    starts = elements.offsets[:-1]
    return _Bounds(
        low=np.minimum.reduceat(elements.points, starts),
        high=np.maximum.reduceat(elements.points, starts),
    )


def _pack(elements: MapElements) -> bytes:
    """Encode elements: first the numbers of elements and vertices, then both, compressed."""
    stored = np.zeros(len(elements), _STORED)
    stored["label"] = elements.labels
    stored["score"] = elements.confidence
    stored["num_vertices"] = elements.num_points
    counts = np.array((len(elements), len(elements.points)), dtype=_COUNTS)
    vertices = elements.points.astype(_VERTEX)
    return counts.tobytes() + zlib.compress(stored.tobytes() + vertices.tobytes(), level=1)


def _check_areas(elements: MapElements, classes: Sequence[str]) -> None:
    """Check that areas can be cut in bounded time: long outlines must not cross themselves.

    Raises:
        ValueError: If the outline of an area is long and crosses itself.
    """
    is_area = np.array([name in AREA_CLASSES for name in classes])
    is_long = elements.num_points > _MOST_VERTICES_OF_CROSSED_AREA
    for row in np.flatnonzero(is_area[elements.labels] & is_long):
        outline = shapely.Polygon(elements.polylines[row])
        if not shapely.is_valid(outline):  # an outline that crosses itself is invalid
            raise InputError(
                f"an area with {elements.num_points[row]} vertices crosses itself: at most "
                f"{_MOST_VERTICES_OF_CROSSED_AREA} are possible then; repair it."
            )


def _unpack(
    content: bytes, crc: int, path: Path, most_vertices: int
) -> tuple[NDArray[np.void], list[FloatArray]]:
    """Decompress a tile of an untrusted file, in bounded memory.

    Args:
        content: Tile of the file.
        crc: Expected checksum of ``content``.
        path: Name of the file, for messages.
        most_vertices: Largest number of vertices, and of elements, that the tile may have.

    Returns:
        Stored elements (N,), and the vertices of each element. (P, 2) each
    """
    damage = InputError(f"{path} is damaged: a tile cannot be read; copy or build it again.")
    if zlib.crc32(content) != crc or len(content) < _COUNTS.itemsize:
        raise damage
    counts = np.frombuffer(content[: _COUNTS.itemsize], dtype=_COUNTS)[0]
    num_elements = int(counts["elements"])
    num_vertices = int(counts["vertices"])
    if max(num_elements, num_vertices) > most_vertices:
        raise damage
    # The checksum of the whole tile was checked above, so `unpack_tile` gets a checksum that fits.
    packed = content[_COUNTS.itemsize :]
    num_bytes_of_elements = num_elements * _STORED.itemsize
    num_bytes = num_bytes_of_elements + num_vertices * 2 * _VERTEX.itemsize
    unpacked = unpack_tile(packed, crc=zlib.crc32(packed), num_bytes=num_bytes, path=path)
    stored = np.frombuffer(unpacked[:num_bytes_of_elements], dtype=_STORED)
    vertices = np.frombuffer(unpacked[num_bytes_of_elements:], dtype=_VERTEX).reshape(-1, 2)
    if int(stored["num_vertices"].sum(dtype=np.int64)) != num_vertices:
        raise damage
    ends = np.cumsum(stored["num_vertices"], dtype=np.int64)
    return stored, np.split(vertices, ends[:-1])
