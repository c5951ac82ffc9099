"""Bags of ROS 1 and ROS 2, written from a drive."""

from dataclasses import replace

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from gsmap.datasets.annotations.record import CameraRecord
from gsmap.datasets.source import ground_from_frame
from gsmap.structures.rigid import invert_rigid, rigid
from mapdata.options import InputOptions

AXLE_M = 0.3  # height of base_link above the road


class Recorder:
    """Writes the messages of a test into a bag of one kind."""

    info_topic, image_topic = "/{}/camera_info", "/{}/image_raw"

    def __init__(self, path, kind):
        self.ros1 = kind == "ros1"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        if self.ros1:
            text = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
            self.path = path.with_suffix(".bag")
            self.writer = Writer1(self.path)
        else:
            self.path = path
            plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
            self.writer = Writer2(path, version=9, storage_plugin=plugin)
        self.connections = {}

    def __enter__(self):
        self.writer.open()
        return self

    def __exit__(self, *_):
        self.writer.close()

    def type(self, name):
        return self.store.types[name]

    def header(self, time_ns, frame):
        sec, nanosec = divmod(time_ns, 10**9)
        stamp = self.type("builtin_interfaces/msg/Time")(sec, nanosec)
        more = {"seq": 0} if self.ros1 else {}
        return self.type("std_msgs/msg/Header")(**more, stamp=stamp, frame_id=frame)

    def send(self, topic, kind, time_ns, **fields):
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        message = self.type(kind)(**fields)
        write = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
        self.writer.write(self.connections[topic], time_ns, write(message, kind))

    def transform(self, topic, time_ns, parent, child, pose):
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
        item = self.type("geometry_msgs/msg/TransformStamped")(
            self.header(time_ns, parent),
            child,
            self.type("geometry_msgs/msg/Transform")(
                self.type("geometry_msgs/msg/Vector3")(*pose[:3, 3].tolist()),
                self.type("geometry_msgs/msg/Quaternion")(x, y, z, w),
            ),
        )
        self.send(topic, "tf2_msgs/msg/TFMessage", time_ns, transforms=[item])

    def odometry(self, topic, time_ns, parent, child, pose):
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
        zero = self.type("geometry_msgs/msg/Vector3")(0.0, 0.0, 0.0)
        self.send(
            topic,
            "nav_msgs/msg/Odometry",
            time_ns,
            header=self.header(time_ns, parent),
            child_frame_id=child,
            pose=self.type("geometry_msgs/msg/PoseWithCovariance")(
                self.type("geometry_msgs/msg/Pose")(
                    self.type("geometry_msgs/msg/Point")(*pose[:3, 3].tolist()),
                    self.type("geometry_msgs/msg/Quaternion")(x, y, z, w),
                ),
                np.zeros(36),
            ),
            twist=self.type("geometry_msgs/msg/TwistWithCovariance")(
                self.type("geometry_msgs/msg/Twist")(zero, zero), np.zeros(36)
            ),
        )

    def region(self, x, y, width, height):
        return self.type("sensor_msgs/msg/RegionOfInterest")(x, y, height, width, False)

    def info(self, camera, time_ns, distortion=(), **changed):
        """Send a camera info; ``changed`` are fields, its arrays ``d``, ``k`` and ``p``."""
        names = ("D", "K", "R", "P") if self.ros1 else ("d", "k", "r", "p")
        k = camera.intrinsics
        values = (np.array(distortion, float), k.ravel(), np.eye(3).ravel(), np.eye(3, 4).ravel())
        fields = {
            "header": self.header(time_ns, f"{camera.name}_optical"),
            "height": camera.height,
            "width": camera.width,
            "distortion_model": "plumb_bob",
            "binning_x": 0,
            "binning_y": 0,
            "roi": self.region(0, 0, 0, 0),
            **dict(zip(names, values, strict=True)),
        }
        self.send(
            self.info_topic.format(camera.name),
            "sensor_msgs/msg/CameraInfo",
            time_ns,
            **fields | changed,
        )

    def image(self, camera, time_ns, content, raw=None, **changed):
        header = self.header(time_ns, f"{camera.name}_optical")
        if raw is None:
            data = np.frombuffer(content, np.uint8)
            kind = "sensor_msgs/msg/CompressedImage"
            topic = f"{self.image_topic.format(camera.name)}/compressed"
            fields = {"header": header, "format": "jpeg", "data": data}
            self.send(topic, kind, time_ns, **fields | changed)
            return
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
        image = image[..., ::-1] if raw == "rgb8" else image
        padded = np.pad(image.reshape(len(image), -1), ((0, 0), (0, 5)))  # rows have a step
        fields = {
            "header": header,
            "height": image.shape[0],
            "width": image.shape[1],
            "encoding": raw,
            "is_bigendian": 0,
            "step": padded.shape[1],
            "data": padded.ravel(),
        }
        self.send(
            self.image_topic.format(camera.name),
            "sensor_msgs/msg/Image",
            time_ns,
            **fields | changed,
        )


def record(recorder, samples, root, poses="tf", raw=None, distortion=(), more=None, damaged=()):
    """Write a drive: all images at their sample's time, poses 10 ms before and after each.

    ``more`` are further images of the first camera by their time in seconds: their content, or
    changed fields of a raw image. ``damaged`` are topics that get a message of a few bytes, too.
    """
    axle = np.eye(4)
    axle[2, 3] = AXLE_M
    with recorder:
        for sample in samples:
            time_ns, ground = sample.timestamp_ns, ground_from_frame(sample, "lidar")
            world_from_base = sample.global_from_frame @ invert_rigid(ground) @ axle
            for shift in (-10_000_000, 10_000_000):
                at = time_ns + shift
                if poses == "tf":
                    recorder.transform("/tf", at, "odom", "base_link", world_from_base)
                    recorder.transform("/tf_static", 0, "map", "odom", np.eye(4))
            for camera in sample.cameras:
                base_from_cam = invert_rigid(axle) @ ground @ invert_rigid(camera.cam_from_frame)
                frame = f"{camera.name}_optical"
                recorder.transform("/tf_static", time_ns, "base_link", frame, base_from_cam)
                recorder.info(camera, time_ns, distortion)
                recorder.image(camera, time_ns, (root / camera.path).read_bytes(), raw)
        camera = samples[0].cameras[0]
        good = (root / camera.path).read_bytes()
        for seconds, image in (more or {}).items():
            at = seconds * 10**9
            recorder.transform("/tf", at, "odom", "base_link", np.eye(4))
            content, changed = (image, {}) if isinstance(image, bytes) else (good, image)
            recorder.image(camera, at, content, raw, **changed)
        for topic in damaged:
            recorder.writer.write(recorder.connections[topic], 1, b"\0\1\0\0\1\2\3")


START_NS = 1_700_000_000_000_000_000
STEP_NS = 100_000_000
AHEAD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # of a camera that looks ahead
PINHOLE = np.array([[250.0, 0, 160], [0, 250, 90], [0, 0, 1]])


def at(x=0.0, y=0.0, z=0.0, rotation=None):
    """Return a pose. (4, 4)"""
    return rigid(np.eye(3) if rotation is None else rotation, (x, y, z))


def picture(width=320, height=180):
    """Return a picture of coloured ramps, BGR. (H, W, 3)"""
    x, y = np.meshgrid(np.linspace(0, 255, width), np.linspace(0, 255, height))
    return np.stack([x, y, 255 - x], -1).astype(np.uint8)


def jpeg(width=320, height=180):
    """Return the picture as JPEG."""
    return cv2.imencode(".jpg", picture(width, height))[1].tobytes()


class Straight:
    """A straight drive at 5 m/s, all cameras 2 m ahead of the origin, images at 10 Hz.

    What is recorded can be changed: methods are replaced by others with the same arguments.
    """

    def __init__(self, recorder, names=("front", "rear"), count=11):
        self.recorder, self.count = recorder, count
        self.cameras = [CameraRecord(n, "", 320, 180, PINHOLE, np.eye(4)) for n in names]
        self.times_ns = [START_NS + i * STEP_NS for i in range(count)]

    def mount(self, camera):
        pose = at(2.0, 0.0, 1.5, AHEAD)
        frame = f"{camera.name}_optical"
        self.recorder.transform("/tf_static", START_NS, "base_link", frame, pose)

    def poses(self, i, time_ns):
        self.recorder.transform("/tf", time_ns, "odom", "base_link", at(0.5 * i))

    def info(self, camera, time_ns):
        self.recorder.info(camera, time_ns)

    def image(self, camera, time_ns):
        self.recorder.image(camera, time_ns, jpeg())

    def before(self):
        """Send further messages at the start."""

    def write(self, **replaced):
        """Record the drive and return its path."""
        for name, method in replaced.items():
            setattr(self, name, method)
        with self.recorder:
            self.before()
            for camera in self.cameras:
                self.mount(camera)
            for i, time_ns in enumerate(self.times_ns):
                self.poses(i, time_ns)
                for camera in self.cameras:
                    self.info(camera, time_ns)
                    self.image(camera, time_ns)
        return self.recorder.path


def options(tmp_path, **more):
    """Return how a test reads its bag: frames beside it, every image a sample."""
    values = {"vehicle_ground_z_m": -AXLE_M, **more}
    return InputOptions(frames_dir=tmp_path / "frames", rate_hz=None, **values)


def starting_at_0(drive, turn=0, **more):
    """Return the first sample at time 0; cameras may have one another's images."""
    sample, paths = drive[0], [camera.path for camera in drive[0].cameras]
    cameras = [
        replace(camera, path=paths[(i + turn) % len(paths)], **more)
        for i, camera in enumerate(sample.cameras)
    ]
    return replace(sample, timestamp_ns=10_000_000, cameras=cameras)
