"""A drive and its map as a recording for the rerun viewer."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import to_rgba_array

from drivemaps.replay import Moment, Replay
from gsmap.datasets.annotations.record import CameraRecord
from gsmap.datasets.image_files import image_content
from gsmap.structures.rigid import invert_rigid
from gsmap.utils.extras import import_extra
from gsmap.utils.files import atomic_write

TIMELINE = "time"
_VEHICLE, _MAP = "world/vehicle", "world/map"


def write_rerun(path: str | Path, replay: Replay) -> None:
    """Write cameras, predictions, their Gaussians as ellipses, and the growing map (``.rrd``).

    Predictions and map stand in space, so that the viewer lays them over the cameras as well.

    Raises:
        FileNotFoundError: If an image is missing.
        BrokenSampleError: If a file is no image, or damaged; nothing of it is copied.
        RuntimeError: If ``rerun-sdk`` is missing.
    """
    rr = import_extra("rerun", "viz")
    recording = rr.RecordingStream("gsmap", recording_id=replay.drive.scene)
    stream = recording.binary_stream()
    cameras = replay.drive.frames[0].sample.cameras
    recording.send_blueprint(_layout(cameras))
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    with atomic_write(path, "wb") as file:
        for moment in replay.moments():
            sample, pose = moment.frame.sample, moment.frame.sample.global_from_frame
            recording.set_time(TIMELINE, timestamp=np.datetime64(sample.timestamp_ns, "ns"))
            recording.log(_VEHICLE, rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
            for camera in sample.cameras:
                _log_camera(recording, rr, camera, replay.data_root)
            _log_predictions(recording, rr, moment, replay.colours)
            rgb = _rgb([label for label, _ in moment.seen], replay.colours)
            lines = [line for _, line in moment.seen]
            recording.log(_MAP, rr.LineStrips3D(lines, colors=rgb, radii=0.1))
            file.write(stream.read(flush=True))
    recording.disconnect()


def _layout(cameras: Sequence[CameraRecord]) -> Any:
    """Lay out the cameras over the map."""
    rrb = import_extra("rerun.blueprint", "viz")
    views = [
        rrb.Spatial2DView(
            origin=f"{_VEHICLE}/{camera.name}",
            name=camera.name,
            contents=["$origin/**", f"{_VEHICLE}/predictions/lines"],
        )
        for camera in cameras
    ]
    map_view = rrb.Spatial3DView(origin="world", name="map")
    return rrb.Blueprint(rrb.Vertical(rrb.Grid(*views), map_view) if views else map_view)


def _log_camera(recording: Any, rr: Any, camera: CameraRecord, data_root: Path | None) -> None:
    """Log where a camera is and what it saw."""
    entity = f"{_VEHICLE}/{camera.name}"
    frame_from_cam = invert_rigid(camera.cam_from_frame)
    recording.log(
        entity,
        rr.Transform3D(translation=frame_from_cam[:3, 3], mat3x3=frame_from_cam[:3, :3]),
        rr.Pinhole(image_from_camera=camera.intrinsics, width=camera.width, height=camera.height),
    )
    if data_root is not None:
        where, size = f"camera {camera.name!r}", (camera.width, camera.height)
        content, kind = image_content(data_root / camera.path, where, size)
        recording.log(entity, rr.EncodedImage(contents=content, media_type=f"image/{kind}"))


def _log_predictions(recording: Any, rr: Any, moment: Moment, colours: Sequence[str]) -> None:
    """Log one frame's predictions and their Gaussians in the annotation frame."""
    elements = moment.frame.elements
    entity = f"{_VEHICLE}/predictions"
    rgb = _rgb(elements.labels.tolist(), colours)
    recording.log(f"{entity}/lines", rr.LineStrips3D(moment.lines, colors=rgb, radii=0.05))
    if moment.ellipses is not None:
        centres, half_axes, quaternions = moment.ellipses
        recording.log(
            f"{entity}/gaussians",
            rr.Ellipsoids3D(
                centers=centres,
                half_sizes=np.column_stack([half_axes, np.full(len(centres), 0.01)]),
                quaternions=quaternions,
                colors=np.repeat(rgb, elements.num_points, axis=0),
            ),
        )


def _rgb(labels: Sequence[int], colours: Sequence[str]) -> np.ndarray:
    """Return the colours of classes. (N, 3) uint8"""
    table = np.round(255 * to_rgba_array(colours)[:, :3]).astype(np.uint8)
    return table[np.asarray(labels, int)]
