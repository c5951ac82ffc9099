"""Writing of MCAP files that show drives and their maps in Foxglove."""

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

# Names of coordinate frames in the file.
_GLOBAL = "global"
_FRAME = "vehicle"  # the annotation frame, which cameras and predictions refer to
_GROUND = "base_footprint"  # x ahead, y left, on the road


def write_mcap(path: str | Path, replay: Replay) -> None:
    """Write a drive as an MCAP file (``.mcap``).

    The file contains the cameras, the predictions, their Gaussians as ellipses, and the map as it
    grows from frame to frame.

    Args:
        path: File to write.
        replay: Drive and its map.

    Raises:
        FileNotFoundError: If an image is missing.
        BrokenSampleError: If an image file is damaged or is not an image. The content of such a
            file is not copied into the MCAP file.
        RuntimeError: If ``foxglove-sdk`` is missing.
    """
    foxglove = import_extra("foxglove", "viz")
    # Only messages that are logged to this context are written to the file.
    log = _Log(foxglove.Context(), replay.colours)
    options = foxglove.mcap.MCAPWriteOptions(profile="gsmap")
    # The contexts end in reverse order: the content is complete before the file gets its name.
    with (
        atomic_write(path, "wb") as file,
        foxglove.open_mcap(file, context=log.context, writer_options=options),
    ):
        for moment in replay.moments():
            sample = moment.frame.sample
            time_ns = sample.timestamp_ns
            frame_from_ground = invert_rigid(
                ground_from_frame(sample, replay.frame_kind, replay.ground_z_m)
            )
            log.transform(_GLOBAL, child=_FRAME, pose=sample.global_from_frame, time_ns=time_ns)
            log.transform(_FRAME, child=_GROUND, pose=frame_from_ground, time_ns=time_ns)
            for camera in sample.cameras:
                log.camera(camera, replay.data_root, time_ns)
            log.predictions(moment, time_ns)
            log.lines("/map", frame=_GLOBAL, lines=moment.map_lines, time_ns=time_ns)


class _Log:
    """Writer of Foxglove messages, with one channel per topic.

    Args:
        context: Context of the channels.
        colours: Colour of each class, ``#RRGGBB``.
    """

    def __init__(self, context: Any, colours: Sequence[str]) -> None:
        self.context = context
        self._messages = import_extra("foxglove.messages", "viz")
        self._channel_types = import_extra("foxglove.channels", "viz")
        self._channels: dict[str, Any] = {}
        self._colours = []
        for colour in colours:
            r, g, b, a = to_rgba(colour)
            self._colours.append(self._messages.Color(r=r, g=g, b=b, a=a))

    def _send(self, topic: str, message: Any, time_ns: int) -> None:
        """Log a message to the channel of its topic, which is created if needed."""
        if topic not in self._channels:
            # A message of the type `SceneUpdate`, for example, needs a `SceneUpdateChannel`.
            create_channel = getattr(self._channel_types, f"{type(message).__name__}Channel")
            self._channels[topic] = create_channel(topic, context=self.context)
        self._channels[topic].log(message, log_time=time_ns)

    def _stamp(self, time_ns: int) -> Any:
        """Convert a time in nanoseconds to Foxglove's timestamp."""
        seconds, nanoseconds = divmod(time_ns, 10**9)
        return self._messages.Timestamp(seconds, nanoseconds)

    def transform(self, parent: str, child: str, pose: FloatArray, time_ns: int) -> None:
        """Log the pose of a frame in its parent frame.

        Args:
            parent: Name of the parent frame.
            child: Name of the frame.
            pose: Transform from the frame to its parent, in metres. (4, 4)
            time_ns: Time in nanoseconds.
        """
        messages = self._messages
        x, y, z = pose[:3, 3].tolist()
        turn_x, turn_y, turn_z, turn_w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
        message = messages.FrameTransform(
            timestamp=self._stamp(time_ns),
            parent_frame_id=parent,
            child_frame_id=child,
            translation=messages.Vector3(x=x, y=y, z=z),
            rotation=messages.Quaternion(x=turn_x, y=turn_y, z=turn_z, w=turn_w),
        )
        self._send(f"/tf/{child}", message, time_ns)

    def camera(self, camera: CameraRecord, data_root: Path | None, time_ns: int) -> None:
        """Log the pose, the calibration and, with a data root, the image of a camera.

        Args:
            camera: Camera of a sample.
            data_root: Folder that image paths are relative to, or None to leave images out.
            time_ns: Time in nanoseconds.
        """
        messages = self._messages
        name = camera.name
        frame_from_cam = invert_rigid(camera.cam_from_frame)
        self.transform(_FRAME, child=name, pose=frame_from_cam, time_ns=time_ns)
        # Foxglove's projection matrix P is (3, 4). Its last column is zero without a stereo pair.
        projection = np.column_stack([camera.intrinsics, np.zeros(3)])
        calibration = messages.CameraCalibration(
            timestamp=self._stamp(time_ns),
            frame_id=name,
            width=camera.width,
            height=camera.height,
            K=camera.intrinsics.ravel().tolist(),
            P=projection.ravel().tolist(),
        )
        self._send(f"/{name}/calibration", calibration, time_ns)
        if data_root is not None:
            size_px = (camera.width, camera.height)  # a file of another size is refused
            path = data_root / camera.path
            # The bytes of the checked file and their format, such as "jpeg".
            content, image_format = image_content(path, f"camera {name!r}", size_px)
            image = messages.CompressedImage(
                timestamp=self._stamp(time_ns),
                frame_id=name,
                data=content,
                format=image_format,
            )
            self._send(f"/{name}/image", image, time_ns)

    def lines(
        self, topic: str, frame: str, lines: Sequence[tuple[int, FloatArray]], time_ns: int
    ) -> None:
        """Log lines in the colours of their classes.

        Args:
            topic: Topic of the lines.
            frame: Name of the frame of the vertices.
            lines: Class index of each line, and its vertices in metres. (n, 3)
            time_ns: Time in nanoseconds.
        """
        messages = self._messages
        primitives = []
        for label, line in lines:
            points = [messages.Point3(x=x, y=y, z=z) for x, y, z in line.tolist()]
            primitive = messages.LinePrimitive(
                thickness=0.15,  # metres
                points=points,
                color=self._colours[label],
            )
            primitives.append(primitive)
        self._send_entity(topic, frame, time_ns, lines=primitives)

    def predictions(self, moment: Moment, time_ns: int) -> None:
        """Log the predictions of one frame and their Gaussians.

        Args:
            moment: Frame of the drive.
            time_ns: Time in nanoseconds.
        """
        # `elements` are in the global frame. `moment.lines` are their vertices in the annotation
        # frame, in the order of `elements`.
        elements = moment.frame.elements
        labels = elements.labels.tolist()
        lines = list(zip(labels, moment.lines, strict=True))
        self.lines("/predictions", frame=_FRAME, lines=lines, time_ns=time_ns)
        if moment.ellipses is None:
            return
        messages = self._messages
        # Each of the M vertices of the predictions has one ellipse. (M, 3), (M, 2) and (M, 4)
        centres, half_axes, quaternions = moment.ellipses
        vertex_labels = np.repeat(elements.labels, elements.num_points)
        spheres = []
        for index, label in enumerate(vertex_labels.tolist()):
            x, y, z = centres[index].tolist()
            half_length, half_width = half_axes[index].tolist()
            _, _, turn_z, turn_w = quaternions[index].tolist()  # a rotation about z
            pose = messages.Pose(
                position=messages.Vector3(x=x, y=y, z=z),
                orientation=messages.Quaternion(z=turn_z, w=turn_w),
            )
            sphere = messages.SpherePrimitive(
                pose=pose,
                # Lengths of the whole axes in metres; nearly flat, so it appears as an ellipse.
                size=messages.Vector3(x=2 * half_length, y=2 * half_width, z=0.02),
                color=self._colours[label],
            )
            spheres.append(sphere)
        self._send_entity("/gaussians", _FRAME, time_ns, spheres=spheres)

    def _send_entity(self, topic: str, frame: str, time_ns: int, **shapes: Any) -> None:
        """Log the shapes of a topic. They replace the previous shapes of the topic."""
        messages = self._messages
        entity = messages.SceneEntity(
            timestamp=self._stamp(time_ns),
            frame_id=frame,
            id=topic,  # an entity replaces the previous one with this id
            frame_locked=True,  # the shapes move with their frame until they are replaced
            **shapes,
        )
        self._send(topic, messages.SceneUpdate(entities=[entity]), time_ns)
