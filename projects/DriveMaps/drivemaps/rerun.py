"""Recordings of drives and their maps for the rerun viewer."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import to_rgba_array

from drivemaps.replay import Moment, Replay
from gsmap.datasets.annotations.record import CameraRecord
from gsmap.datasets.image_files import image_content
from gsmap.structures.elements import FloatArray
from gsmap.structures.rigid import invert_rigid
from gsmap.utils.extras import import_extra
from gsmap.utils.files import atomic_write

TIMELINE = "time"
# Paths of entities in the recording. The viewer applies the transform of an entity to all entities
# below its path, so entities below the vehicle are logged in the annotation frame.
_VEHICLE = "world/vehicle"
_MAP = "world/map"
_ORIGIN = "origin"


def write_rerun(path: str | Path, replay: Replay) -> None:
    """Write a drive as a rerun recording (``.rrd``).

    It contains cameras, predictions, their Gaussians as ellipses, and the growing map. Predictions
    and map are logged in 3D, so the viewer also projects them into the cameras. The first position,
    rounded to metres, is subtracted from the poses and the map, because coordinates of rerun are
    float32. It is logged as a text.

    Args:
        path: File to write.
        replay: Drive and its map.

    Raises:
        FileNotFoundError: If an image is missing.
        BrokenSampleError: If an image file is damaged or is not an image. The recording is not
            written in this case.
        RuntimeError: If ``rerun-sdk`` is missing.
    """
    rr = import_extra("rerun", "viz")  # an optional dependency, imported only here
    recording = rr.RecordingStream("gsmap", recording_id=replay.drive.name)
    stream = recording.binary_stream()  # collects the logged data until it is read
    cameras = replay.drive.frames[0].sample.cameras
    recording.send_blueprint(_blueprint(cameras))
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    # Coordinates of a map grid have errors of up to 4 m in float32.
    origin = np.round(replay.drive.frames[0].sample.global_from_frame[:3, 3])
    x, y, z = origin.astype(np.int64).tolist()
    text = f"The origin of the recording is x {x}, y {y}, z {z} m in the global frame."
    recording.log(_ORIGIN, rr.TextDocument(text), static=True)
    with atomic_write(path, "wb") as file:
        # A moment is one frame with the part of the map that the drive has explored so far.
        for moment in replay.moments():
            sample = moment.frame.sample
            recording.set_time(TIMELINE, timestamp=np.datetime64(sample.timestamp_ns, "ns"))
            pose = sample.global_from_frame.copy()
            pose[:3, 3] -= origin
            recording.log(_VEHICLE, _transform(rr, pose))
            for camera in sample.cameras:
                _log_camera(recording, rr, camera=camera, data_root=replay.data_root)
            _log_predictions(recording, rr, moment=moment, colours=replay.colours)
            labels = []
            lines = []
            for label, line in moment.map_lines:
                labels.append(label)
                lines.append(line - origin)
            rgb = _rgb(labels, replay.colours)
            recording.log(_MAP, rr.LineStrips3D(lines, colors=rgb, radii=0.1))
            file.write(stream.read(flush=True))  # after each frame, to limit the memory
    recording.disconnect()


def _blueprint(cameras: Sequence[CameraRecord]) -> Any:
    """Layout of the viewer: cameras above the map."""
    rrb = import_extra("rerun.blueprint", "viz")
    map_view = rrb.Spatial3DView(origin="world", name="map")
    if not cameras:
        return rrb.Blueprint(map_view)
    camera_views: list[Any] = []
    for camera in cameras:
        view = rrb.Spatial2DView(
            origin=f"{_VEHICLE}/{camera.name}",
            name=camera.name,
            # The camera with its image, and the predicted lines, which the viewer projects.
            contents=["$origin/**", f"{_VEHICLE}/predictions/lines"],
        )
        camera_views.append(view)
    return rrb.Blueprint(rrb.Vertical(rrb.Grid(*camera_views), map_view))


def _transform(rr: Any, pose: FloatArray) -> Any:
    """Rigid transform (4, 4) as a component of rerun."""
    return rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3])


def _log_camera(recording: Any, rr: Any, camera: CameraRecord, data_root: Path | None) -> None:
    """Log the pose, the intrinsics and, with a data root, the image of a camera."""
    entity = f"{_VEHICLE}/{camera.name}"
    pinhole = rr.Pinhole(
        image_from_camera=camera.intrinsics, width=camera.width, height=camera.height
    )
    # rerun expects the transform from an entity to its parent, here from camera to vehicle.
    recording.log(entity, _transform(rr, invert_rigid(camera.cam_from_frame)), pinhole)
    if data_root is not None:
        size_px = (camera.width, camera.height)
        # The content of the file is copied after a check that it is an image of this size.
        content, kind = image_content(data_root / camera.path, f"camera {camera.name!r}", size_px)
        image = rr.EncodedImage(contents=content, media_type=f"image/{kind}")
        recording.log(entity, image)


def _log_predictions(recording: Any, rr: Any, moment: Moment, colours: Sequence[str]) -> None:
    """Log the predictions of one frame and their Gaussians in the annotation frame."""
    elements = moment.frame.elements
    entity = f"{_VEHICLE}/predictions"
    rgb = _rgb(elements.labels.tolist(), colours)
    recording.log(f"{entity}/lines", rr.LineStrips3D(moment.lines, colors=rgb, radii=0.05))
    if moment.ellipses is not None:
        # One ellipse per vertex: centre and half axes in metres, rotation as (x, y, z, w).
        centres, half_axes, quaternions = moment.ellipses
        thickness = np.full(len(centres), 0.01)  # third half axis in metres: nearly flat
        # Each vertex of an element has one Gaussian, with the colour of the element.
        gaussian_rgb = np.repeat(rgb, elements.num_points, axis=0)
        ellipsoids = rr.Ellipsoids3D(
            centers=centres,
            half_sizes=np.column_stack([half_axes, thickness]),
            quaternions=quaternions,
            colors=gaussian_rgb,
        )
        recording.log(f"{entity}/gaussians", ellipsoids)


def _rgb(labels: Sequence[int], colours: Sequence[str]) -> np.ndarray:
    """Colour of each element, from its class index and the colours of the classes. (N, 3) uint8"""
    rgb_of_class = np.round(255 * to_rgba_array(colours)[:, :3]).astype(np.uint8)
    return rgb_of_class[np.asarray(labels, int)]
