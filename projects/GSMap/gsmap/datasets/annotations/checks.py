"""What samples of an annotation file must be: checked where one is written and where it is read."""

from collections.abc import Callable

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from gsmap.datasets.annotations.record import AnnotationMeta
from gsmap.datasets.annotations.schema import matrices_of
from gsmap.structures.elements import FARTHEST_M
from gsmap.structures.rigid import is_rigid
from gsmap.utils.errors import InputError

_OPTIONAL = {"lidar", "can_bus", "instances", "ego_from_frame"}
_PLACES = {"cameras[]": "camera's ", "lidar": "LiDAR ", "sweeps[]": "sweep's "}
_OUTSIDE = r"^$|^/|[\\\x00-\x1f]|(^|/)\.\.(/|$)"  # of a data root, with forward slashes


def check_batch(batch: pa.RecordBatch, meta: AnnotationMeta) -> None:
    """Check the values of a batch of samples.

    Labels are among the classes, points and calibration finite, transforms rigid (proper rotations
    to 1e-3), focal lengths and image sizes positive, and paths relative and inside the data root.
    Names of scenes, maps and cameras must lead nowhere else, either, if a path is made of them.

    Raises:
        ValueError: If a value is wrong or missing; the message names the sample.
    """
    walk = _Walk(batch.column("token"), meta)
    for name in batch.schema.names:
        walk.check(batch.column(name), name, np.arange(len(batch)))


class _Walk:
    """A walk through a batch, which checks every array and all that is in it."""

    def __init__(self, tokens: pa.StringArray, meta: AnnotationMeta) -> None:
        self.tokens = tokens
        self.meta = meta

    def check(self, array: pa.Array, name: str, rows: np.ndarray, where: str = "") -> None:
        """Check an array; ``rows`` are the samples that its items belong to. (items,)."""
        if array.null_count:
            known = array.is_valid().to_numpy(zero_copy_only=False)
            self.require(known | (name in _OPTIONAL), rows, f"{where}{name} is missing")
            array, rows = array.drop_null(), rows[known]
        if pa.types.is_struct(array.type):
            for part in array.type:
                self.check(array.field(part.name), part.name, rows, where + _PLACES.get(name, ""))
        elif pa.types.is_list(array.type):
            lengths = np.diff(array.offsets.to_numpy())
            if lengths.sum() != len(array.values):
                raise InputError(f"{where}{name} has items that belong to no sample.")
            if pa.types.is_struct(array.type.value_type):
                self.check(array.values, f"{name}[]", np.repeat(rows, lengths), where)
        if name in _RULES:
            rule, wrong = _RULES[name]
            good = rule(array, rows, self.meta)
            value = None if good.all() else array[int(np.argmin(good))].as_py()
            self.require(good, rows, where + name + wrong.format(value, self.meta))

    def require(self, good: np.ndarray, rows: np.ndarray, wrong: str) -> None:
        """Raise an error that names the sample of the first item that is not good."""
        if not good.all():
            token = self.tokens[int(rows[np.argmin(good)])].as_py()
            raise InputError(f"sample {token!r}: {wrong}.")


@np.errstate(invalid="ignore", over="ignore")
def _are_pinholes(arrays: pa.FixedSizeListArray, *_of: object) -> np.ndarray:
    entries = np.ascontiguousarray(matrices_of(arrays, 9).T)  # each in one piece
    good = np.isfinite(entries.sum(0)) & (entries[[0, 4]] > 0).all(0)
    return good & (entries[6] == 0) & (entries[7] == 0) & (entries[8] == 1)


def _are_inside(paths: pa.StringArray, *_of: object) -> np.ndarray:
    text = b"" if paths.buffers()[2] is None else paths.buffers()[2].to_pybytes()
    starts = np.frombuffer(paths.buffers()[1], np.int32, len(paths) + 1)[:-1]
    # a look at the bytes is enough for nearly all files, and much faster than an expression
    letters = np.frombuffer(text + b"/", np.uint8)
    plain = b".." not in text and b"\\" not in text and (letters >= ord(" ")).all()
    if plain and (letters[starts] != ord("/")).all():
        return np.ones(len(paths), bool)
    return ~pc.match_substring_regex(paths, _OUTSIDE).to_numpy(zero_copy_only=False)


def _are_own_names(names: pa.StringArray, rows: np.ndarray, _meta: AnnotationMeta) -> np.ndarray:
    """Say which cameras have a good name of their own in their sample."""
    encoded = names.dictionary_encode()
    each = rows * len(encoded.dictionary) + encoded.indices.to_numpy()
    return (np.bincount(each)[each] == 1) & _are_inside(names)


def _are_polylines(lists: pa.ListArray, _rows: np.ndarray, meta: AnnotationMeta) -> np.ndarray:
    """Say which polylines have two points or more, all of them finite and within reach."""
    counts = np.diff(lists.offsets.to_numpy())
    good = (counts % meta.dim == 0) & (counts >= 2 * meta.dim)
    near = np.abs(lists.values.to_numpy(zero_copy_only=False)) <= FARTHEST_M  # NaN is not
    if not near.all():
        good[np.repeat(np.arange(len(counts)), counts)[~near]] = False
    return good


_FARTHEST_POSE_M = 1e8  # several times the Earth
_TRANSFORM = (
    lambda arrays, *_: (
        is_rigid(matrices_of(arrays, 4, 4))
        & (np.abs(matrices_of(arrays, 4, 4)[:, :3, 3]) <= _FARTHEST_POSE_M).all(-1)
    ),
    " is no rigid transform: it must be finite, with a rotation, a translation within 100,000 km "
    "and 0, 0, 0, 1 below",
)
_SIZE = lambda numbers, *_: numbers.to_numpy() > 0, " {0}: the size is not positive"
_NAME = (
    lambda texts, *_: pc.equal(texts, "").to_numpy(zero_copy_only=False) | _are_inside(texts),
    " {0!r} would lead out of a folder or has control characters: give it a plain name",
)
_RULES: dict[str, tuple[Callable[..., np.ndarray], str]] = {
    "token": (lambda texts, *_: pc.not_equal(texts, "").to_numpy(False), " is empty"),
    "scene": _NAME,
    "map_name": _NAME,
    "global_from_frame": _TRANSFORM,
    "ego_from_frame": _TRANSFORM,
    "cam_from_frame": _TRANSFORM,
    "frame_from_lidar": _TRANSFORM,
    "can_bus": (
        lambda arrays, *_: np.isfinite(matrices_of(arrays, 18)).all(-1),
        " holds NaN or infinity",
    ),
    "name": (
        _are_own_names,
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
        lambda labels, _, meta: (labels.to_numpy() >= 0) & (labels.to_numpy() < len(meta.classes)),
        " {0} is none of the classes {1.classes}",
    ),
    "points": (
        _are_polylines,
        " of an element must be (n >= 2, {1.dim}), not NaN or infinite, nor beyond 100 km",
    ),
}
"""By field: which items of an array are good, and what is said of the first that is not."""
