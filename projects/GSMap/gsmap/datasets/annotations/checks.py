"""What samples of an annotation file must be: checked where one is written and where it is read."""

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from gsmap.datasets.annotations.record import AnnotationMeta
from gsmap.datasets.annotations.schema import Batch
from gsmap.structures.rigid import is_rigid

_OUTSIDE = r"^$|^/|\\|\x00|(^|/)\.\.(/|$)"  # of a data root, with forward slashes


def check_batch(batch: Batch, meta: AnnotationMeta) -> None:
    """Check the values of a batch of samples.

    Labels are among the classes, points and calibration finite, transforms rigid (proper rotations
    to 1e-3), focal lengths and image sizes positive, and paths relative and inside the data root.

    Raises:
        ValueError: If a value is wrong; the message names the sample.
    """
    each = np.arange(len(batch) + 1)
    if pc.any(pc.equal(batch.column["token"], "")).as_py():
        raise ValueError("a sample has an empty token.")
    _require_rigid(batch.global_from_frame, each, batch, "global_from_frame")
    if batch.has_mounting.any():
        known = np.cumsum([0, *batch.has_mounting])
        mountings = batch.ego_from_frame[batch.has_mounting]
        _require_rigid(mountings, known, batch, "ego_from_frame")
    if batch.has_can_bus.any():
        finite = np.isfinite(batch.can_bus).all(-1) | ~batch.has_can_bus
        _require(finite, each, batch, "can_bus holds NaN or infinity")
    _check_cameras(batch)
    if batch.has_lidar.any():
        known = np.cumsum([0, *batch.has_lidar])
        matrices = batch.frame_from_lidar[batch.has_lidar]
        _require_rigid(matrices, known, batch, "frame_from_lidar")
        paths = batch.lidar_path.filter(pa.array(batch.has_lidar))
        _require_inside(paths, known, batch, "LiDAR path")
        _require_inside(batch.sweep["path"], batch.sweep_offsets, batch, "path of a LiDAR sweep")
        _require_rigid(batch.sweep_from, batch.sweep_offsets, batch, "frame_from_lidar of a sweep")
    _check_instances(batch, meta)


def _require(good: np.ndarray, offsets: np.ndarray, batch: Batch, wrong: str) -> None:
    """Raise a ``ValueError`` that names the sample of the first item that is not good."""
    if offsets[0] != 0 or offsets[-1] != len(good):
        raise ValueError("a list has items that belong to no sample.")
    if not good.all():
        row = int(np.searchsorted(offsets, np.argmin(good), side="right")) - 1
        raise ValueError(f"sample {batch.column['token'][row].as_py()!r}: {wrong}.")


def _require_rigid(matrices: np.ndarray, offsets: np.ndarray, batch: Batch, name: str) -> None:
    wrong = f"{name} is no rigid transform: it must be finite, with a rotation and 0, 0, 0, 1 below"
    _require(is_rigid(matrices), offsets, batch, wrong)


def _require_inside(paths: pa.StringArray, offsets: np.ndarray, batch: Batch, name: str) -> None:
    stored = paths.buffers()[2]
    text = b"" if stored is None else stored.to_pybytes()
    letters = np.frombuffer(text + b"/", np.uint8)
    starts = np.frombuffer(paths.buffers()[1], np.int32, len(paths) + 1)
    # a look at the bytes is enough for nearly all files, and much faster than an expression
    dots = letters == ord(".")
    odd = (dots[1:] & dots[:-1]).any() or b"\\" in text or b"\0" in text
    if not odd and (letters[starts[:-1]] != ord("/")).all():
        return
    good = ~pc.match_substring_regex(paths, _OUTSIDE).to_numpy(False)
    wrong = f"{name} must be relative to the data root, with forward slashes and without '..'"
    if not good.all():
        wrong += f", got {paths[int(np.argmin(good))].as_py()!r}"
    _require(good, offsets, batch, wrong)


@np.errstate(invalid="ignore", over="ignore")
def _check_cameras(batch: Batch) -> None:
    offsets = batch.camera_offsets
    width, height = (batch.camera[name].to_numpy() for name in ("width", "height"))
    _require((width > 0) & (height > 0), offsets, batch, "a camera's size is not positive")
    names = batch.camera["name"].dictionary_encode()
    each = np.repeat(np.arange(len(batch)) * len(names.dictionary), np.diff(offsets))
    each += names.indices.to_numpy(False)
    _require(np.bincount(each)[each] == 1, offsets, batch, "a camera appears twice")
    _require_inside(batch.camera["path"], offsets, batch, "path of a camera")
    entries = np.ascontiguousarray(batch.intrinsics.reshape(-1, 9).T)  # each in one piece
    good = np.isfinite(entries.sum(0)) & (entries[[0, 4]] > 0).all(0)
    good &= (entries[6] == 0) & (entries[7] == 0) & (entries[8] == 1)
    wrong = "intrinsics of a camera must be finite, with focal lengths > 0 and 0, 0, 1 below"
    _require(good, offsets, batch, wrong)
    _require_rigid(batch.cam_from_frame, offsets, batch, "cam_from_frame of a camera")


def _check_instances(batch: Batch, meta: AnnotationMeta) -> None:
    labels, offsets = batch.labels, batch.instance_offsets
    good = (labels >= 0) & (labels < len(meta.classes))
    label = 0 if good.all() else labels[np.argmin(good)]
    _require(good, offsets, batch, f"label {label} is none of the classes {meta.classes}")
    counts = np.diff(batch.point_offsets)
    good = (counts % meta.dim == 0) & (counts >= 2 * meta.dim)
    _require(good, offsets, batch, f"points of an element must be (n >= 2, {meta.dim})")
    wrong = "points of an element hold NaN or infinity"
    _require(np.isfinite(batch.points), batch.point_offsets[offsets], batch, wrong)
