"""Checks of the values in annotation files, before writing and after reading."""

from collections.abc import Callable

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from gsmap.datasets.annotations.record import AnnotationMeta
from gsmap.datasets.annotations.schema import matrices_of
from gsmap.structures.calibration import NUM_CAN_BUS
from gsmap.structures.elements import FARTHEST_M, MAX_LENGTH_M
from gsmap.structures.rigid import is_rigid
from gsmap.utils.errors import InputError

# Fields whose value may be missing (null in the file).
_OPTIONAL = {"lidar", "can_bus", "instances", "ego_from_frame"}
# For a column or field with nested fields: words before the names of these fields in messages. The
# suffix ``[]`` stands for the items of a list.
_PREFIXES = {"cameras[]": "camera's ", "lidar": "LiDAR ", "sweeps[]": "sweep's "}
# Paths that are empty or absolute, have backslashes or control characters, or have a part "..".
_OUTSIDE = r"^$|^/|[\\\x00-\x1f]|(^|/)\.\.(/|$)"


def check_batch(batch: pa.RecordBatch, meta: AnnotationMeta) -> None:
    """Check the values of a batch of samples.

    Labels must be among the classes, points and calibration finite, transforms rigid (proper
    rotations to 1e-3), focal lengths and image sizes positive, and paths relative and inside the
    data root. Names of scenes, maps and cameras must be safe as parts of a path.

    Args:
        batch: Batch of samples with the columns of an annotation file.
        meta: Metadata of the file.

    Raises:
        ValueError: If a value is wrong or missing. The message names the sample.
    """
    checker = _BatchChecker(batch.column("token"), meta)
    for name in batch.schema.names:
        checker.check(batch.column(name), name=name, rows=np.arange(len(batch)))


class _BatchChecker:
    """Recursive check of the nested arrays of a batch.

    Args:
        tokens: Tokens of the samples, for messages.
        meta: Metadata of the file.
    """

    def __init__(self, tokens: pa.StringArray, meta: AnnotationMeta) -> None:
        self.tokens = tokens
        self.meta = meta

    def check(self, array: pa.Array, name: str, rows: np.ndarray, where: str = "") -> None:
        """Check an array and all nested arrays.

        Args:
            array: Array of a column or a field.
            name: Name of the column or field; with ``[]`` for items of a list.
            rows: For each item, the index of its sample in the batch. (items,)
            where: Beginning of messages, such as "camera's "; empty for columns.

        Raises:
            ValueError: If a value is wrong or missing.
        """
        # Only items of optional fields may be missing. The checks below skip missing items.
        if array.null_count:
            is_valid = array.is_valid().to_numpy(zero_copy_only=False)
            if name not in _OPTIONAL:
                self.require(is_valid, rows=rows, problem=f"{where}{name} is missing")
            array = array.drop_null()
            rows = rows[is_valid]
        if pa.types.is_struct(array.type):
            prefix = where + _PREFIXES.get(name, "")
            for field in array.type:
                self.check(array.field(field.name), name=field.name, rows=rows, where=prefix)
        elif pa.types.is_list(array.type):
            lengths = np.diff(array.offsets.to_numpy())  # number of items of each list
            # In a damaged file, the offsets may skip items. The rows of items would then be wrong.
            if lengths.sum() != len(array.values):
                raise InputError(f"{where}{name} has items that belong to no sample.")
            if pa.types.is_struct(array.type.value_type):
                item_rows = np.repeat(rows, lengths)
                self.check(array.values, name=f"{name}[]", rows=item_rows, where=where)
        if name in _RULES:
            rule, text = _RULES[name]
            is_good = rule(array, rows, self.meta)
            if not is_good.all():
                first_wrong = array[int(np.argmin(is_good))].as_py()  # argmin: the first False
                problem = where + name + text.format(first_wrong, self.meta)
                self.require(is_good, rows=rows, problem=problem)

    def require(self, is_good: np.ndarray, rows: np.ndarray, problem: str) -> None:
        """Raise an error unless all items are good.

        Args:
            is_good: Result of the check of each item. (items,)
            rows: For each item, the index of its sample in the batch. (items,)
            problem: Message about the first wrong item.

        Raises:
            ValueError: If an item is wrong, with the token of its sample.
        """
        if not is_good.all():
            token = self.tokens[int(rows[np.argmin(is_good)])].as_py()
            raise InputError(f"sample {token!r}: {problem}.")


@np.errstate(invalid="ignore", over="ignore")  # no warnings about sums of invalid entries
def _are_pinholes(arrays: pa.FixedSizeListArray, *_: object) -> np.ndarray:
    """Test which intrinsics are valid pinhole matrices."""
    entries = np.ascontiguousarray(matrices_of(arrays, (9,)).T)  # (9, items), contiguous entries
    are_finite = np.isfinite(entries.sum(0))  # the sum is not finite if an entry is not
    have_focal_lengths = (entries[0] > 0) & (entries[4] > 0)  # fx and fy
    have_last_row = (entries[6] == 0) & (entries[7] == 0) & (entries[8] == 1)
    return are_finite & have_focal_lengths & have_last_row


def _are_transforms(arrays: pa.FixedSizeListArray, *_: object) -> np.ndarray:
    """Test which matrices are rigid transforms with a translation within the limit."""
    matrices = matrices_of(arrays, (4, 4))
    are_near = (np.abs(matrices[:, :3, 3]) <= FARTHEST_M).all(-1)
    return is_rigid(matrices) & are_near


def _are_inside(paths: pa.StringArray, *_: object) -> np.ndarray:
    """Test which paths are relative, inside the data root and without control characters."""
    # Arrow stores all texts of an array as one text, with the offsets of the single texts.
    _, offsets, data = paths.buffers()
    text = b"" if data is None else data.to_pybytes()
    bounds = np.frombuffer(offsets, dtype=np.int32, count=len(paths) + 1)
    # Fast path for nearly all files: a scan of the bytes instead of a regular expression.
    letters = np.frombuffer(text, dtype=np.uint8)  # UTF-8; control characters are below the space
    are_plain = b".." not in text and b"\\" not in text and (letters >= ord(" ")).all()
    are_filled = (np.diff(bounds) > 0).all()
    # The first letter of path i is letters[bounds[i]].
    if are_plain and are_filled and (letters[bounds[:-1]] != ord("/")).all():
        return np.ones(len(paths), dtype=bool)
    return ~pc.match_substring_regex(paths, _OUTSIDE).to_numpy(zero_copy_only=False)


def _are_names(names: pa.StringArray, *_: object) -> np.ndarray:
    """Test which names of scenes or maps are empty or safe as parts of a path."""
    are_empty = pc.equal(names, "").to_numpy(zero_copy_only=False)
    return are_empty | _are_inside(names)


def _are_camera_names(names: pa.StringArray, rows: np.ndarray, _: AnnotationMeta) -> np.ndarray:
    """Test which names of cameras are unique in their sample and safe as parts of a path."""
    encoded = names.dictionary_encode()  # replaces each name by its index among distinct names
    # One number for each pair of a sample and a name.
    keys = rows * len(encoded.dictionary) + encoded.indices.to_numpy()
    are_unique = np.bincount(keys)[keys] == 1
    return are_unique & _are_inside(names)


def _are_labels(labels: pa.Int32Array, _: np.ndarray, meta: AnnotationMeta) -> np.ndarray:
    """Test which labels are indices of a class."""
    numbers = labels.to_numpy()
    return (numbers >= 0) & (numbers < len(meta.classes))


def _are_polylines(lists: pa.ListArray, _: np.ndarray, meta: AnnotationMeta) -> np.ndarray:
    """Test which polylines have two or more points, all finite and within the limit."""
    # A polyline is stored as a flat list of the coordinates of its points.
    counts = np.diff(lists.offsets.to_numpy())  # coordinates of each polyline
    are_good = (counts % meta.dim == 0) & (counts >= 2 * meta.dim)
    are_near = np.abs(lists.values.to_numpy(zero_copy_only=False)) <= MAX_LENGTH_M  # False for NaN
    if not are_near.all():
        # Index of the polyline of each coordinate.
        line_numbers = np.repeat(np.arange(len(counts)), counts)
        are_good[line_numbers[~are_near]] = False
    return are_good


# Entries of `_RULES` that several fields share: a test and a message.
_TRANSFORM = (
    _are_transforms,
    " is no rigid transform: it must be finite, with a rotation, a translation within 100,000 km "
    "and 0, 0, 0, 1 below",
)
_SIZE = (
    lambda numbers, *_: numbers.to_numpy() > 0,
    " {0}: the size is not positive",
)
_NAME = (
    _are_names,
    " {0!r} would lead out of a folder or has control characters: give it a plain name",
)
_RULES: dict[str, tuple[Callable[..., np.ndarray], str]] = {
    "token": (
        lambda texts, *_: pc.not_equal(texts, "").to_numpy(zero_copy_only=False),
        " is empty",
    ),
    "scene": _NAME,
    "map_name": _NAME,
    "global_from_frame": _TRANSFORM,
    "ego_from_frame": _TRANSFORM,
    "cam_from_frame": _TRANSFORM,
    "frame_from_lidar": _TRANSFORM,
    "can_bus": (
        lambda arrays, *_: np.isfinite(matrices_of(arrays, (NUM_CAN_BUS,))).all(-1),
        " holds NaN or infinity",
    ),
    "name": (
        _are_camera_names,
        " {0!r} appears twice, is empty, would lead out of a folder or has control characters",
    ),
    "path": (
        _are_inside,
        " must be relative to the data root, with forward slashes and without '..', got {0!r}",
    ),
    "width": _SIZE,
    "height": _SIZE,
    "intrinsics": (_are_pinholes, " must be finite, with focal lengths > 0 and 0, 0, 1 below"),
    "label": (
        _are_labels,
        " {0} is none of the classes {1.classes}",
    ),
    "points": (
        _are_polylines,
        " of an element must be (n >= 2, {1.dim}), not NaN or infinite, nor beyond 100 km",
    ),
}
"""By the name of a field, the test of its items and the message about the first wrong item.

Arguments of a test are the array, the index of the sample of each item, and the metadata. The test
returns a mask that is True for good items. The message follows the name of the field; in it, {0} is
the item and {1} is the metadata.
"""
