"""A drive and its map as an MCAP file for Foxglove."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import to_rgba
from scipy.spatial.transform import Rotation

from drivemaps.replay import Moment, Replay
from gsmap.datasets.annotations.record import CameraRecord
from gsmap.datasets.image_files import image_content
from gsmap.datasets.source import ground_from_frame
from gsmap.structures.elements import FloatArray
from gsmap.structures.rigid import invert_rigid
from gsmap.utils.extras import import_extra
from gsmap.utils.files import atomic_write

_GLOBAL, _FRAME, _GROUND = "global", "vehicle", "base_footprint"  # x ahead, y left, on the road


def write_mcap(path: str | Path, replay: Replay) -> None:
    """Write cameras, predictions, their Gaussians as ellipses, and the growing map (``.mcap``).

    Raises:
        FileNotFoundError: If an image is missing.
        BrokenSampleError: If a file is no image, or damaged; nothing of it is copied.
        RuntimeError: If ``foxglove-sdk`` is missing.
    """
    foxglove = import_extra("foxglove", "viz")
    log = _Log(foxglove.Context(), replay.colours)
    with atomic_write(path, "wb") as file, foxglove.open_mcap(file, context=log.context):
        for moment in replay.moments():
            sample, time_ns = moment.frame.sample, moment.frame.sample.timestamp_ns
            log.transform(_GLOBAL, _FRAME, sample.global_from_frame, time_ns)
            ground = invert_rigid(ground_from_frame(sample, replay.frame_kind, replay.ground_z_m))
            log.transform(_FRAME, _GROUND, ground, time_ns)
            for camera in sample.cameras:
                log.camera(camera, replay.data_root, time_ns)
            log.predictions(moment, time_ns)
            log.lines("/map", _GLOBAL, moment.seen, time_ns)


class _Log:
    """Foxglove's messages, each on a channel of its own.

    Args:
        context: Where channels belong.
        colours: Colour of each class, ``#RRGGBB``.
    """

    def __init__(self, context: Any, colours: Sequence[str]) -> None:
        self.context = context
        self._messages = import_extra("foxglove.messages", "viz")
        self._kinds = import_extra("foxglove.channels", "viz")
        self._channels: dict[str, Any] = {}
        self._colours = [
            self._messages.Color(**dict(zip("rgba", to_rgba(colour), strict=True)))
            for colour in colours
        ]

    def _send(self, topic: str, message: Any, time_ns: int) -> None:
        if topic not in self._channels:
            kind = getattr(self._kinds, f"{type(message).__name__}Channel")
            self._channels[topic] = kind(topic, context=self.context)
        self._channels[topic].log(message, log_time=time_ns)

    def _stamp(self, time_ns: int) -> Any:
        return self._messages.Timestamp(*divmod(time_ns, 10**9))

    def transform(self, parent: str, child: str, pose: FloatArray, time_ns: int) -> None:
        """Log where a frame stands in its parent."""
        m, (x, y, z) = self._messages, pose[:3, 3].tolist()
        turn = dict(zip("xyzw", Rotation.from_matrix(pose[:3, :3]).as_quat().tolist(), strict=True))
        message = m.FrameTransform(
            timestamp=self._stamp(time_ns),
            parent_frame_id=parent,
            child_frame_id=child,
            translation=m.Vector3(x=x, y=y, z=z),
            rotation=m.Quaternion(**turn),
        )
        self._send(f"/tf/{child}", message, time_ns)

    def camera(self, camera: CameraRecord, data_root: Path | None, time_ns: int) -> None:
        """Log a camera's place, calibration and image."""
        m, stamp = self._messages, self._stamp(time_ns)
        self.transform(_FRAME, camera.name, invert_rigid(camera.cam_from_frame), time_ns)
        projection = np.column_stack([camera.intrinsics, np.zeros(3)])
        calibration = m.CameraCalibration(
            timestamp=stamp,
            frame_id=camera.name,
            width=camera.width,
            height=camera.height,
            K=camera.intrinsics.ravel().tolist(),
            P=projection.ravel().tolist(),
        )
        self._send(f"/{camera.name}/calibration", calibration, time_ns)
        if data_root is not None:
            where, size = f"camera {camera.name!r}", (camera.width, camera.height)
            content, kind = image_content(data_root / camera.path, where, size)
            image = m.CompressedImage(
                timestamp=stamp, frame_id=camera.name, data=content, format=kind
            )
            self._send(f"/{camera.name}/image", image, time_ns)

    def lines(
        self, topic: str, frame: str, lines: Sequence[tuple[int, FloatArray]], time_ns: int
    ) -> None:
        """Log labelled lines in one frame."""
        m = self._messages
        shapes = [
            m.LinePrimitive(
                thickness=0.15,
                points=[m.Point3(x=x, y=y, z=z) for x, y, z in line.tolist()],
                color=self._colours[label],
            )
            for label, line in lines
        ]
        self._entity(topic, frame, time_ns, lines=shapes)

    def predictions(self, moment: Moment, time_ns: int) -> None:
        """Log one frame's predictions and their Gaussians."""
        m, elements = self._messages, moment.frame.elements
        labels = elements.labels.tolist()
        self.lines("/predictions", _FRAME, list(zip(labels, moment.lines, strict=True)), time_ns)
        if moment.ellipses is not None:
            owners = np.repeat(elements.labels, elements.num_points).tolist()
            columns = (values.tolist() for values in moment.ellipses)
            ellipses = [
                m.SpherePrimitive(
                    pose=m.Pose(
                        position=m.Vector3(x=x, y=y, z=z),
                        orientation=m.Quaternion(z=turn[2], w=turn[3]),
                    ),
                    size=m.Vector3(x=2 * a, y=2 * b, z=0.02),
                    color=self._colours[label],
                )
                for (x, y, z), (a, b), turn, label in zip(*columns, owners, strict=True)
            ]
            self._entity("/gaussians", _FRAME, time_ns, spheres=ellipses)

    def _entity(self, topic: str, frame: str, time_ns: int, **shapes: Any) -> None:
        """Log one entity, which replaces the topic's earlier one."""
        m = self._messages
        entity = m.SceneEntity(
            timestamp=self._stamp(time_ns), frame_id=frame, id=topic, frame_locked=True, **shapes
        )
        self._send(topic, m.SceneUpdate(entities=[entity]), time_ns)
