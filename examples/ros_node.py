"""ROS 2 node that takes rectified images and their CameraInfo, and publishes map elements.

The map elements are published as markers. Copy this file, and replace the constants below by the
cameras and frames of your vehicle.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import Point
from rclpy.node import Node
from rclpy.time import Time
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, Image
from tf2_ros import Buffer, TransformException, TransformListener
from visualization_msgs.msg import Marker, MarkerArray

from gsmap import MapElements, MapInferencer
from gsmap.structures.rigid import rigid

MODEL = "gsmap_r18_minicity"
# Name of each camera, and the namespace of its topics image_rect and camera_info. A name may be one
# of the cameras in the training data of the model, or any other name.
CAMERAS = {"CAM_FRONT": "/front", "CAM_BACK": "/rear"}
VEHICLE = "base_footprint"  # x ahead, y left, on the road below the rear axle
MIN_SCORE = 0.3
PERIOD_S = 0.5
MAX_DELAY_S = 0.1  # largest time by which an image may be older than the newest one
# Encodings of images that the node takes, and the slice of the channels red, green and blue.
RGB = slice(0, 3)
BGR = slice(2, None, -1)
ENCODINGS = {"rgb8": RGB, "bgr8": BGR, "rgba8": RGB, "bgra8": BGR}
# RGB of the classes divider, ped_crossing and boundary, in the order of the model's labels.
COLOURS = [(0.2, 0.6, 1.0), (1.0, 0.6, 0.1), (0.2, 0.8, 0.3)]


class MapNode(Node):
    """Publishes the map of the newest images, twice a second."""

    def __init__(self) -> None:
        super().__init__("gsmap")
        self.inferencer = MapInferencer(MODEL)
        self.live = None  # function from images to map elements, made for the calibration
        self.projections = {}  # projection matrices that `live` was made for, by camera
        self.images = {}  # latest Image message of each camera, by the name of the camera
        self.infos = {}  # latest CameraInfo message of each camera
        for name, topic in CAMERAS.items():
            # Each message replaces the previous one of its camera. The last argument of a
            # subscription, 1, is the length of the queue: older images are dropped.
            keep_image = partial(self.images.__setitem__, name)
            keep_info = partial(self.infos.__setitem__, name)
            self.create_subscription(Image, f"{topic}/image_rect", keep_image, 1)
            self.create_subscription(CameraInfo, f"{topic}/camera_info", keep_info, 1)
        self.transforms = Buffer()
        self.listener = TransformListener(self.transforms, self)
        self.publisher = self.create_publisher(MarkerArray, "map_elements", 1)
        self.create_timer(PERIOD_S, self.step)

    def cam_from_vehicle(self, info: Any) -> np.ndarray:
        """Transform from the vehicle to a camera, in metres. (4, 4)

        Args:
            info: CameraInfo message, whose header names the frame of the camera.

        Raises:
            TransformException: If tf has no such transform (yet).
        """
        camera = info.header.frame_id
        # tf returns the transform from the second frame to the first one. `Time()` is the time 0,
        # which asks for the latest transform.
        transform = self.transforms.lookup_transform(camera, VEHICLE, Time()).transform
        turn = transform.rotation
        shift = transform.translation
        rotation = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
        return rigid(rotation, [shift.x, shift.y, shift.z])

    def step(self) -> None:
        """Predict and publish the map, if every camera has sent a new image and its CameraInfo."""
        if len(self.images) < len(CAMERAS) or len(self.infos) < len(CAMERAS):
            missing = sorted(set(CAMERAS) - (self.images.keys() & self.infos.keys()))
            self.get_logger().warning(f"no map: no new image or no CameraInfo of {missing}")
            return
        images = self.images.copy()
        newest_s = max(map(seconds, images.values()))
        late = [name for name in images if newest_s - seconds(images[name]) > MAX_DELAY_S]
        if late:
            self.get_logger().warning(f"no map: the images of {late} are late")
            return
        projections = {name: tuple(info.p) for name, info in self.infos.items()}
        if projections != self.projections:  # also at the first images
            intrinsics = {}
            mounting = {}
            for name, info in self.infos.items():
                # `p` belongs to the rectified image, and `k` to the image before rectification.
                projection = np.reshape(info.p, (3, 4))
                intrinsics[name] = projection[:, :3]
                try:
                    mounting[name] = self.cam_from_vehicle(info)
                except TransformException as error:
                    # tf sends the transforms after the start. The next step tries once more.
                    self.get_logger().warning(f"no transform to camera {name} yet: {error}")
                    return
            # The frame "vehicle" of the library has the axes and the origin of VEHICLE. CAMERAS may
            # have fewer cameras than the model was trained with.
            self.live = self.inferencer.live(
                intrinsics, cam_from_frame=mounting, frame="vehicle", allow_missing_cameras=True
            )
            self.projections = projections
        self.images.clear()  # so that a camera that stops does not lend an old image to a later map
        elements = self.live({name: rgb(message) for name, message in images.items()})
        confident = elements.select(elements.confidence > MIN_SCORE)
        # The images may have slightly different times. The time of one of them stands for all.
        stamp = next(iter(images.values())).header.stamp
        # A viewer keeps old markers until they are erased.
        erase = Marker(action=Marker.DELETEALL)
        self.publisher.publish(MarkerArray(markers=[erase, *markers(confident, stamp)]))


def seconds(message: Any) -> float:
    """Time of a message."""
    stamp = message.header.stamp
    return float(stamp.sec + stamp.nanosec / 1e9)


def rgb(message: Any) -> np.ndarray:
    """RGB pixels of an image message. (H, W, 3)

    Raises:
        ValueError: If its encoding is not one of ``ENCODINGS``.
    """
    encoding = message.encoding
    if encoding not in ENCODINGS:
        frame = message.header.frame_id
        known = ", ".join(ENCODINGS)
        raise ValueError(f"images of {frame} have encoding {encoding!r}: convert them to {known}.")
    num_channels = len(encoding) - 1  # 3 letters of colours, or 4 with the alpha channel
    # A row has `step` bytes, which may include padding at its end.
    rows = np.frombuffer(message.data, np.uint8).reshape(message.height, message.step)
    pixels = rows[:, : num_channels * message.width].reshape(message.height, message.width, -1)
    return pixels[..., ENCODINGS[encoding]]


def markers(elements: MapElements, stamp: Any) -> Iterator[Any]:
    """Yield a line marker for each element, in the vehicle's frame.

    Args:
        elements: Map elements in the frame of the vehicle, in metres.
        stamp: Time of the images.
    """
    for number, (line, label) in enumerate(zip(elements.polylines, elements.labels, strict=True)):
        marker = Marker(id=number, type=Marker.LINE_STRIP)
        marker.header.frame_id = VEHICLE
        marker.header.stamp = stamp
        marker.points = [Point(x=x, y=y, z=0.0) for x, y in line[:, :2].tolist()]
        marker.color.r, marker.color.g, marker.color.b = COLOURS[label % len(COLOURS)]
        marker.color.a = 1.0
        marker.scale.x = 0.1  # width of the line in metres
        marker.pose.orientation.w = 1.0  # no rotation
        yield marker


def main() -> None:
    """Run the node until it is interrupted."""
    rclpy.init()
    rclpy.spin(MapNode())


if __name__ == "__main__":
    main()
