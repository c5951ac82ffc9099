"""Gaussian prior: the lines of earlier drives, stored as Gaussians in tiles of the global frame."""

import threading
import zlib
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsmap.ops.gaussian_raster import render_gaussians
from gsmap.prior.file_format import (
    GAUSSIAN_MAGIC,
    TileKey,
    read_file,
    save_file,
    unpack_tile,
)
from gsmap.prior.gaussian_rule import GaussianRule
from gsmap.prior.gaussian_updates import (
    LineSamples,
    Measurements,
    find_covered_points,
    fuse_across,
    measure,
    sample_lines,
)
from gsmap.prior.inputs import PlanarPose, Pose, Raster, planar_pose, to_numpy
from gsmap.prior.reads import PriorReads
from gsmap.prior.settings import PriorSettings
from gsmap.prior.sources import PriorSources
from gsmap.structures.elements import FloatArray, MapElements
from gsmap.structures.grid import BEVGrid
from gsmap.utils.errors import InputError

Stored = NDArray[np.void]
"""Gaussians of a tile, an array of ``_STORED``; positions are relative to its corner."""
# Units are metres, radians and square metres. The variance is across the line.
_STORED = np.dtype(
    [
        ("label", "<u2"),
        ("position", "<f4", (2,)),
        ("angle", "<f4"),
        ("variance", "<f4"),
        ("hits", "<f4"),
        ("misses", "<f4"),
    ]
)
_MOST_PER_TILE = 100_000  # in a file
_COUNT_BYTES = 4  # a tile in a file begins with the number of its Gaussians, in these bytes
# A Gaussian is removed if its value is below the first number, and its hits and misses together
# are at least the second one.
_FORGOTTEN_VALUE = 0.1
_FORGOTTEN_VIEWS = 3.0
_LARGEST_VARIANCE = 1e4  # of a stored Gaussian, in square metres
_FAR_M = 1e6  # position of padding, which no raster reaches


class GaussianMasks(NamedTuple):
    """Prior in the cells of a frame.

    Attributes:
        mean: Lines at their mean positions, with the width of a line, in [0, 1]. (C, H, W)
        spread: Lines widened by the standard deviations of their positions, in [0, 1]. (C, H, W)
    """

    mean: Tensor
    spread: Tensor


class GaussianPrior:
    """Gaussians along the lines of earlier drives, each with a class, counts and a covariance.

    A Gaussian represents a piece of a line. Every line that measures it updates its centre, its
    direction and its variance across the line, by a Kalman filter in information form. Its standard
    deviation along the line is half of the distance between neighbouring Gaussians. It also has
    counts of hits and misses, which decay. A frame that has the Gaussian in view adds p to its hits
    and 1 - p to its misses, where p is the score of the line that measures it, or 0 without such a
    line. The value of a Gaussian is the share of hits (`GaussianRule`). Areas are stored as their
    outlines. All methods may be called from several threads. All Gaussians are kept in memory.

    Args:
        settings: Classes, place (name of the global frame) and tiles; the size of cells is not
            used.
        rule: Settings of the Gaussians; ``GaussianRule()`` by default.

    Attributes:
        content: Name of the stored objects, for messages.
        reads: Samples at which a model has read this prior.
        sources: Samples that this prior was made of, added by the code that makes it.
    """

    content: ClassVar[str] = "Gaussians"

    def __init__(self, settings: PriorSettings, rule: GaussianRule | None = None) -> None:
        self.settings = settings
        self.rule = GaussianRule() if rule is None else rule
        self.reads = PriorReads()
        self.sources = PriorSources()
        self._tiles: dict[TileKey, Stored] = {}
        self._lock = threading.RLock()

    @classmethod
    def load(cls, path: str | Path, settings: PriorSettings | None = None) -> "GaussianPrior":
        """Read a file that `save` has written.

        Args:
            path: File of the prior. It may be untrusted.
            settings: Classes, place and tiles that the file must have; None to accept any.

        Raises:
            FileNotFoundError: If the file does not exist.
            ValueError: If the file is no valid Gaussian prior, or has other settings.
        """
        path = Path(path)
        # Each entry is the offset, length and checksum of a tile in `content`.
        content, header = read_file(path, settings, magic=GAUSSIAN_MAGIC)
        prior = cls(header.settings, header.rule)
        prior.sources = header.sources
        for key, (offset, length, crc) in header.entries.items():
            packed = content[offset : offset + length]
            stored = _unpack(packed, crc=crc, path=path)
            _check_stored(stored, settings=header.settings, path=path)
            prior._tiles[key] = stored
        return prior

    def save(self, path: str | Path) -> None:
        """Write the prior to a file, which replaces ``path`` when it is complete.

        Args:
            path: File to create or replace.

        Raises:
            RuntimeError: If the file is reserved by another process.
            ValueError: If a tile has more than 100,000 Gaussians, or another program has written
                the lock file beside it.
        """
        with self._lock:
            most = max((len(stored) for stored in self._tiles.values()), default=0)
            if most > _MOST_PER_TILE:
                raise InputError(
                    f"{path} cannot be written: a tile has {most} Gaussians, and {_MOST_PER_TILE} "
                    f"are possible. Build the prior with a tile_m below {self.settings.tile_m:g} m."
                )
            # The order of the keys makes the files of equal priors equal.
            tiles = [(key, _pack(self._tiles[key])) for key in sorted(self._tiles)]
            save_file(
                Path(path),
                self.settings,
                rule=self.rule,
                tiles=tiles,
                magic=GAUSSIAN_MAGIC,
                sources=self.sources,
            )

    @property
    def num_gaussians(self) -> int:
        """Number of all Gaussians."""
        with self._lock:
            return sum(len(stored) for stored in self._tiles.values())

    def gaussians(self, label: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the Gaussians of a class.

        Args:
            label: Index of the class.

        Returns:
            Centres in metres in the global frame (N, 2), covariances in square metres (N, 2, 2),
            and values in [0, 1] (N,). Gaussians with small values, which are not drawn, are
            included.
        """
        with self._lock:
            gaussians = _GaussianSet.gather(self._tiles, sorted(self._tiles), self.settings.tile_m)
        gaussians = gaussians.select(gaussians.labels == label)
        cos = np.cos(gaussians.angles)
        sin = np.sin(gaussians.angles)
        # Rotation matrices, whose columns are the directions along and across the line. (N, 2, 2)
        first_rows = np.stack([cos, -sin], axis=-1)
        second_rows = np.stack([sin, cos], axis=-1)
        axes = np.stack([first_rows, second_rows], axis=-2)
        along_variances = np.full(len(cos), (self.rule.spacing_m / 2) ** 2)
        variances = np.stack([along_variances, gaussians.variances], axis=-1)
        covariances = (axes * variances[:, None, :]) @ axes.transpose(0, 2, 1)
        return gaussians.means, covariances, gaussians.values(self.rule)

    def write(
        self, pose: Pose, grid: BEVGrid, elements: MapElements, visible: Raster | None = None
    ) -> None:
        """Update the prior with the prediction of a frame.

        A Gaussian is measured by the nearest line of its class that crosses its normal within
        1.5 m. For a Gaussian in view without such a line, a miss is counted. Each line is sampled
        at points. A new Gaussian is added at each point without a Gaussian of its class within
        1.5 m across the line and three quarters of the spacing along it.

        Args:
            pose: Transform from the frame to the global frame, in metres. Far from the origin it
                must be float64. (4, 4)
            grid: Extent of the frame, which is in view, and its cells, H rows and W columns.
            elements: Prediction in metres in the frame, with labels of the classes of the prior.
            visible: Whether a cell of ``grid`` is in view and not occluded, bool; None if all are.
                A Gaussian outside of these cells does not change unless a line measures it. (H, W)

        Raises:
            ValueError: If a label or a shape is wrong, or ``pose`` is no rigid transform or too far
                from the origin.
        """
        num_classes = len(self.settings.classes)
        labels = elements.labels
        if len(labels) and not 0 <= labels.min() <= labels.max() < num_classes:
            raise InputError(f"labels of elements must be in [0, {num_classes}).")
        in_view = None
        if visible is not None:
            in_view = to_numpy(visible)
            if in_view.shape != (grid.height, grid.width) or in_view.dtype != np.bool_:
                raise InputError(f"visible must be bool of shape {(grid.height, grid.width)}.")
        frame = planar_pose(pose)  # position and yaw; heights and tilts are not used
        with self._lock:
            keys = self._keys_in_view(frame, grid)
            gaussians = _GaussianSet.gather(self._tiles, keys, self.settings.tile_m)
            is_in_view = gaussians.are_in_view(frame, grid, in_view=in_view)
            updated_sets = []
            for label in range(num_classes):
                is_of_class = gaussians.labels == label
                of_class = gaussians.select(is_of_class)  # a copy
                lines = sample_lines(elements, label, frame, rule=self.rule)
                # For each Gaussian, the line that measures it and the distance from this line.
                measurements = measure(of_class.means, of_class.angles, lines)
                of_class.update(measurements, is_in_view[is_of_class], self.rule)
                remaining = of_class.select(~of_class.are_forgotten(self.rule))
                updated_sets.append(remaining)
                updated_sets.append(_new_gaussians(remaining, lines, label=label, rule=self.rule))
            # Some Gaussians may have moved to another tile, so all of them are distributed again.
            for key in keys:
                self._tiles.pop(key, None)
            _GaussianSet.join(updated_sets).scatter(self._tiles, self.settings.tile_m)

    def read(self, pose: Pose, grid: BEVGrid) -> Tensor:
        """Draw the lines at their mean positions in the cells of a frame, as `MapPrior.read` does.

        Args:
            pose: Transform from the frame of ``grid`` to the global frame, in metres. Far from the
                origin it must be float64. (4, 4)
            grid: Extent and cells of the frame, H rows and W columns.

        Returns:
            Values in [0, 1], float32 on the device of ``pose``. (C, H, W)

        Raises:
            ValueError: If ``pose`` is no rigid transform or too far from the origin.
        """
        return self.read_masks(pose, grid).mean

    def read_masks(self, pose: Pose, grid: BEVGrid) -> GaussianMasks:
        """Draw the prior in the cells of a frame (GSMap Eq. 6).

        Gaussians whose value is below ``rule.least_value`` are not drawn.

        Args:
            pose: Transform from the frame of ``grid`` to the global frame, in metres. Far from the
                origin it must be float64. (4, 4)
            grid: Extent and cells of the frame, H rows and W columns.

        Returns:
            Masks of means and of spreads, float32 on the device of ``pose``.

        Raises:
            ValueError: If ``pose`` is no rigid transform or too far from the origin.
        """
        frame = planar_pose(pose)
        with self._lock:
            keys = self._keys_in_view(frame, grid)
            gaussians = _GaussianSet.gather(self._tiles, keys, self.settings.tile_m)
        gaussians = gaussians.select(gaussians.values(self.rule) >= self.rule.least_value)
        # Gaussians of each class, padded to the number n of the class with the most Gaussians:
        # arrays (C, n, ...).
        num_classes = len(self.settings.classes)
        counts = np.bincount(gaussians.labels, minlength=num_classes)
        shape = (num_classes, max(1, int(counts.max(initial=0))))
        means = np.full((*shape, 2), _FAR_M)
        scales = np.ones((2, *shape, 2))  # for the masks of means and of spreads
        rotations = np.zeros(shape)
        local = frame.to_frame(gaussians.means)
        local_angles = gaussians.angles - np.arctan2(frame.sin, frame.cos)
        line_sigma_m = self.rule.line_sigma_m  # standard deviation of a drawn line across it
        for label in range(num_classes):
            chosen = gaussians.labels == label
            part = (label, slice(counts[label]))  # entries of the class without the padding
            means[part] = local[chosen]
            rotations[part] = local_angles[chosen]
            scales[:, label, : counts[label], 0] = self.rule.spacing_m / 2
            scales[0, label, : counts[label], 1] = line_sigma_m
            spread_variances = line_sigma_m**2 + gaussians.variances[chosen]
            scales[1, label, : counts[label], 1] = np.sqrt(spread_variances)
        device = pose.device if isinstance(pose, Tensor) else torch.device("cpu")
        # The masks of means and of spreads are drawn in one call. They differ only in the scales.
        masks = render_gaussians(
            torch.from_numpy(np.stack([means, means])).float().to(device),
            torch.from_numpy(scales).float().to(device),
            rotations=torch.from_numpy(np.stack([rotations, rotations])).float().to(device),
            grid=grid,
        )  # (2, C, H, W)
        return GaussianMasks(masks[0], spread=masks[1])

    def _keys_in_view(self, frame: PlanarPose, grid: BEVGrid) -> list[TileKey]:
        """Keys (column, row) of the stored tiles in view of a frame or in a margin around the view.

        The margin is for lines that cross the edge of the view.
        """
        x0, x1 = grid.x_range
        y0, y1 = grid.y_range
        corners = frame.to_global(np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]))
        margin_m = 5 * self.rule.spacing_m
        low = np.floor((corners.min(axis=0) - margin_m) / self.settings.tile_m).astype(int)
        high = np.floor((corners.max(axis=0) + margin_m) / self.settings.tile_m).astype(int)
        keys = []
        for column in range(low[0], high[0] + 1):
            for row in range(low[1], high[1] + 1):
                if (column, row) in self._tiles:
                    keys.append((column, row))
        return keys


class _GaussianSet:
    """Gaussians of some tiles in the global frame, in float64.

    Args:
        labels: Indices of the classes. (N,)
        means: Centres in metres. (N, 2)
        angles: Directions of the lines in radians. (N,)
        variances: Variances across the lines in square metres. (N,)
        hits: Counts of hits. (N,)
        misses: Counts of misses. (N,)
    """

    def __init__(
        self,
        labels: NDArray[np.int64],
        means: FloatArray,
        angles: FloatArray,
        variances: FloatArray,
        hits: FloatArray,
        misses: FloatArray,
    ) -> None:
        self.labels = labels
        self.means = means
        self.angles = angles
        self.variances = variances
        self.hits = hits
        self.misses = misses

    @classmethod
    def gather(
        cls, tiles: dict[TileKey, Stored], keys: list[TileKey], tile_m: float
    ) -> "_GaussianSet":
        """Join the Gaussians of tiles, and convert their positions to the global frame."""
        # The empty array is for the case of no tiles.
        stored = np.concatenate([np.zeros(0, _STORED), *(tiles[key] for key in keys)])
        counts = [len(tiles[key]) for key in keys]
        # Corner of each tile with the smallest x and y. (tiles, 2)
        corners = tile_m * np.array(keys, dtype=np.float64).reshape(-1, 2)
        return cls(
            labels=stored["label"].astype(np.int64),
            means=stored["position"].astype(np.float64) + np.repeat(corners, counts, axis=0),
            angles=stored["angle"].astype(np.float64),
            variances=stored["variance"].astype(np.float64),
            hits=stored["hits"].astype(np.float64),
            misses=stored["misses"].astype(np.float64),
        )

    @classmethod
    def join(cls, parts: list["_GaussianSet"]) -> "_GaussianSet":
        """Concatenate Gaussians."""
        columns = {}
        for name in ("labels", "means", "angles", "variances", "hits", "misses"):
            columns[name] = np.concatenate([getattr(part, name) for part in parts])
        return cls(**columns)

    def select(self, index: NDArray[np.bool_]) -> "_GaussianSet":
        """Select Gaussians by a mask. (N,)"""
        return _GaussianSet(
            labels=self.labels[index],
            means=self.means[index],
            angles=self.angles[index],
            variances=self.variances[index],
            hits=self.hits[index],
            misses=self.misses[index],
        )

    def values(self, rule: GaussianRule) -> FloatArray:
        """Values in [0, 1]: hits / (hits + misses + prior_count). (N,)"""
        values: FloatArray = self.hits / (self.hits + self.misses + rule.prior_count)
        return values

    def are_forgotten(self, rule: GaussianRule) -> NDArray[np.bool_]:
        """Whether a Gaussian has been missed so often that it is removed. (N,)"""
        is_weak = self.values(rule) < _FORGOTTEN_VALUE
        return is_weak & (self.hits + self.misses >= _FORGOTTEN_VIEWS)

    def are_in_view(
        self, frame: PlanarPose, grid: BEVGrid, in_view: NDArray[np.bool_] | None
    ) -> NDArray[np.bool_]:
        """Whether a Gaussian lies in a visible cell of a frame. (N,)"""
        cells = np.floor(grid.px_from_metres(frame.to_frame(self.means))).astype(np.int64)
        columns, rows = cells.T
        is_inside = (columns >= 0) & (columns < grid.width) & (rows >= 0) & (rows < grid.height)
        if in_view is not None:
            inside = np.flatnonzero(is_inside)
            is_inside[inside] = in_view[rows[inside], columns[inside]]
        return is_inside

    def update(
        self, measurements: Measurements, is_in_view: NDArray[np.bool_], rule: GaussianRule
    ) -> None:
        """Update Gaussians in place by their measurements, and count hits and misses.

        Args:
            measurements: Measurements. (N,) each
            is_in_view: Whether a Gaussian is in view. (N,)
            rule: Settings.
        """
        # A line at the edge of the view may measure a Gaussian that is just outside of the view.
        is_observed = is_in_view | measurements.is_found
        # A gain is the share of the distance by which a centre moves; 0 without a measurement.
        variances, gains = fuse_across(
            self.variances, measurements, rule.decay, least_variance=rule.least_sigma_m**2
        )
        normals = np.stack([-np.sin(self.angles), np.cos(self.angles)], axis=1)
        self.means = self.means + (gains * measurements.distances)[:, None] * normals
        self.angles = self.angles + gains * measurements.turns
        self.variances = variances
        scores = measurements.scores  # 0 without a measurement
        decay = np.where(is_observed, rule.decay, 1.0)
        self.hits = decay * self.hits + scores
        self.misses = decay * self.misses + np.where(is_observed, 1.0 - scores, 0.0)

    def scatter(self, tiles: dict[TileKey, Stored], tile_m: float) -> None:
        """Add each Gaussian to the tile that contains its centre."""
        tile_keys = np.floor(self.means / tile_m).astype(np.int64)  # columns and rows. (N, 2)
        # Distinct keys, and the index of the key of each Gaussian. Versions of NumPy differ in the
        # shape of these indices, (N,) or (N, 1).
        keys, key_indices = np.unique(tile_keys, axis=0, return_inverse=True)
        key_indices = key_indices.ravel()
        stored = np.zeros(len(self.labels), _STORED)
        stored["label"] = self.labels
        # The quotient above is rounded, so a centre may lie outside of its tile by a rounding.
        stored["position"] = np.clip(self.means - tile_m * tile_keys, 0.0, tile_m)
        # Updates may have moved an angle out of [-pi, pi].
        stored["angle"] = np.arctan2(np.sin(self.angles), np.cos(self.angles))
        stored["variance"] = np.minimum(self.variances, _LARGEST_VARIANCE)
        stored["hits"] = self.hits
        stored["misses"] = self.misses
        for number, (column, row) in enumerate(keys.tolist()):
            added = stored[key_indices == number]
            present = tiles.get((column, row), np.zeros(0, _STORED))
            tiles[column, row] = np.concatenate([present, added])


def _new_gaussians(
    remaining: _GaussianSet, lines: LineSamples, label: int, rule: GaussianRule
) -> _GaussianSet:
    """Create Gaussians at the points of lines that no Gaussian describes.

    Args:
        remaining: Gaussians of the class.
        lines: Points along the lines of the frame.
        label: Index of the class.
        rule: Settings.
    """
    is_covered = find_covered_points(
        remaining.means, remaining.angles, lines=lines, spacing_m=rule.spacing_m
    )
    is_new = ~is_covered
    scores = lines.scores[is_new]
    return _GaussianSet(
        labels=np.full(len(scores), label),
        means=lines.points[is_new],
        angles=lines.angles[is_new],
        variances=np.maximum(lines.variances[is_new], rule.least_sigma_m**2),
        hits=scores,
        misses=1.0 - scores,
    )


def _pack(stored: Stored) -> bytes:
    """Compress the Gaussians of a tile."""
    count = len(stored).to_bytes(_COUNT_BYTES, "little")
    return count + zlib.compress(stored.tobytes(), level=1)


def _unpack(content: bytes, crc: int, path: Path) -> Stored:
    """Decompress the Gaussians of a tile, in bounded memory."""
    count = int.from_bytes(content[:_COUNT_BYTES], "little")
    if zlib.crc32(content) != crc or len(content) < _COUNT_BYTES or count > _MOST_PER_TILE:
        raise InputError(f"{path} is damaged: a tile cannot be read; copy or build it again.")
    packed = content[_COUNT_BYTES:]
    num_bytes = count * _STORED.itemsize
    # `unpack_tile` needs a checksum of the compressed bytes alone. The stored checksum includes the
    # count, and is checked above. A tile that is larger than `num_bytes` is refused.
    states = unpack_tile(packed, crc=zlib.crc32(packed), num_bytes=num_bytes, path=path)
    return np.frombuffer(states, dtype=_STORED)


def _check_stored(stored: Stored, settings: PriorSettings, path: Path) -> None:
    """Check the values of untrusted Gaussians."""
    position = stored["position"]
    variance = stored["variance"]
    is_valid = (stored["label"] < len(settings.classes)) & np.isfinite(stored["angle"])
    is_valid &= ((position >= 0) & (position <= settings.tile_m)).all(axis=1)
    is_valid &= (variance > 0) & (variance <= _LARGEST_VARIANCE)
    for name in ("hits", "misses"):
        is_valid &= (stored[name] >= 0) & np.isfinite(stored[name])
    if not is_valid.all():
        raise InputError(f"{path} is damaged: a Gaussian is out of range; build it again.")
