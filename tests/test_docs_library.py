"""The blocks of docs/library.md run, one after the other; the node of ROS 2 runs on a stand-in."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

REPO = Path(__file__).resolve().parents[1]
DOCS = REPO / "docs"
PAGE = DOCS / "library.md"


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> dict:
    """All values that the page's blocks leave, and the folder that they ran in."""
    folder, scope = tmp_path_factory.mktemp("library"), {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for block in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL):
            exec(block, scope)
    return {**scope, "folder": folder}


def test_the_metric_scores_arrays(ran):
    assert ran["report"].name == "raster"
    aps = [ran["figures"][f"{name}/divider/AP"] for name in ("chamfer", "raster")]
    assert aps == pytest.approx([1.0, 0.9], abs=0.11)
    for report in ran["evaluator"].reports(ran["matches"]):
        assert report.metrics.items() <= ran["figures"].items()


def test_the_loss_moves_gaussians_onto_the_line(ran):
    assert ran["losses"][-1] < 0.1 * ran["losses"][0]
    x, y = ran["means"][0].detach().unbind(-1)
    on_line = 2 * (y + 20) / 40
    assert float((x - on_line).abs().max()) < 0.3


def test_a_model_sees_images_in_memory(ran):
    shipped = {path.stem for path in (REPO / "models").glob("*.pth")}
    assert set(ran["list_models"]()[: len(shipped)]) == shipped
    assert not ran["model"].training
    assert len(ran["elements"]) > 0
    assert ran["elements"].has_gaussians
    assert (ran["folder"] / "sample.png").stat().st_size > 10_000


def test_the_map_lies_where_the_vehicle_is(ran):
    found = json.loads((ran["folder"] / "map.geojson").read_text())["features"]
    assert len(found) == len(ran["best"]) > 0
    centre = np.mean(
        [p for f in found for p in np.reshape(f["geometry"]["coordinates"], (-1, 2))], 0
    )
    # 120 m east and 45 m north of the origin, within the map's 30 m
    degrees = 360 / 40_030_000
    east, north = (centre - (11.67, 48.26)) / degrees * (np.cos(np.radians(48.26)), 1)
    assert np.hypot(east - 120, north - 45) < 30


class Message(SimpleNamespace):
    """A message of ROS: attributes are there when they are first asked for."""

    LINE_STRIP, DELETEALL = 4, 3

    def __getattr__(self, name: str) -> "Message":
        if name.startswith("__"):
            raise AttributeError(name)
        setattr(self, name, Message())
        return vars(self)[name]


class Node:
    """What the example uses of a node: topics, what is published, and warnings."""

    def __init__(self, name: str) -> None:
        self.topics, self.published, self.warnings = {}, [], []

    def get_logger(self):
        return SimpleNamespace(warning=self.warnings.append)

    def create_subscription(self, kind, topic, callback, depth):
        self.topics[topic] = callback

    def create_publisher(self, kind, topic, depth):
        return SimpleNamespace(publish=self.published.append)

    def create_timer(self, period_s, callback):
        assert period_s == 0.5


class NoTransformError(Exception):
    """tf has no such transform."""


class Buffer:
    """Transforms of a front camera, 2 m ahead and 1.5 m up, and of its twin to the rear."""

    filled = False

    def lookup_transform(self, target, source, time):
        assert source == "base_footprint"
        if not self.filled:
            raise NoTransformError("unknown frame")
        ahead = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
        turn = ahead if target == "front_optical" else np.array(ahead) @ np.diag([-1, -1, 1])
        x, y, z, w = Rotation.from_matrix(turn).as_quat()
        rotation = SimpleNamespace(x=x, y=y, z=z, w=w)
        shift = np.array(turn) @ [-2.0 if target == "front_optical" else 2.0, 0, -1.5]
        translation = SimpleNamespace(**dict(zip("xyz", shift, strict=True)))
        found = SimpleNamespace(rotation=rotation, translation=translation)
        return SimpleNamespace(transform=found)


def test_the_node_of_ros_publishes_the_map_of_its_images(monkeypatch):
    names = {
        "rclpy": {},
        "rclpy.node": {"Node": Node},
        "rclpy.time": {"Time": object},
        "geometry_msgs.msg": {"Point": Message},
        "sensor_msgs.msg": {"CameraInfo": Message, "Image": Message},
        "tf2_ros": {
            "Buffer": Buffer,
            "TransformException": NoTransformError,
            "TransformListener": lambda *_: None,
        },
        "visualization_msgs.msg": {"Marker": Message, "MarkerArray": Message},
    }
    for name, content in names.items():
        for module in (name.partition(".")[0], name):
            monkeypatch.setitem(sys.modules, module, ModuleType(module))
        vars(sys.modules[name]).update(content)
    script = DOCS.parent / "examples/ros_node.py"
    scope = {"__name__": "node"}
    exec(compile(script.read_text(), script.name, "exec"), scope)
    node = scope["MapNode"]()
    node.step()
    assert node.published == []  # no camera has spoken
    assert (
        node.warnings.pop() == "no map: no new image or no CameraInfo of ['CAM_BACK', 'CAM_FRONT']"
    )
    pixels = np.random.default_rng(0).integers(0, 256, (225, 410, 3), np.uint8)
    p = [320.0, 0, 200, 0, 0, 320, 112, 0, 0, 0, 1, 0]

    def send(place, second, p=p):
        stamp = Message(sec=second, nanosec=5)
        header = Message(frame_id=f"{place}_optical", stamp=stamp)
        shape = {"height": 225, "width": 400, "step": 3 * 410, "encoding": "bgr8"}
        node.topics[f"/{place}/image_rect"](Message(header=header, data=pixels.tobytes(), **shape))
        node.topics[f"/{place}/camera_info"](Message(header=header, p=p))
        return header

    send("front", 7)
    header = send("rear", 7)
    image = scope["rgb"](node.images["CAM_FRONT"])
    np.testing.assert_array_equal(image, pixels[:, :400, ::-1])
    for encoding, channels in {"rgba8": [2, 1, 0, 3], "bgra8": [0, 1, 2, 3]}.items():
        four = np.insert(pixels, 3, values=9, axis=2)[..., channels].tobytes()
        shape = {"height": 225, "width": 400, "step": 4 * 410, "encoding": encoding}
        np.testing.assert_array_equal(scope["rgb"](Message(data=four, **shape)), image)
    for encoding in ("mono8", "rgb16", "8UC3", "bayer_rggb8"):
        foreign = Message(header=header, encoding=encoding)
        with pytest.raises(ValueError, match=f"of rear_optical have encoding '{encoding}': conv"):
            scope["rgb"](foreign)
    rigs, live = [], node.inferencer.live

    def scored(intrinsics, cam_from_frame, frame, **options):
        rigs.append((intrinsics, cam_from_frame, frame))
        run = live(intrinsics, cam_from_frame, frame, **options)
        return lambda images: replace(found := run(images), scores=np.linspace(0, 1, len(found)))

    node.inferencer.live = scored
    node.step()
    assert node.published == rigs == []
    assert node.warnings == ["no transform to camera CAM_FRONT yet: unknown frame"]
    node.transforms.filled = True
    node.step()
    send("front", 8)
    send("rear", 8)
    node.step()
    ((intrinsics, mounting, frame),) = rigs  # fitted once
    send("front", 9)
    node.step()  # without a new image of the rear camera
    send("rear", 8)
    node.step()  # with an image that is late
    assert node.warnings[1:] == [
        "no map: no new image or no CameraInfo of ['CAM_BACK']",
        "no map: the images of ['CAM_BACK'] are late",
    ]
    assert len(node.published) == 2
    send("rear", 9, p=[640.0, *p[1:]])
    node.step()
    assert rigs[1][0]["CAM_BACK"][0, 0] == 640  # the calibration has changed
    np.testing.assert_array_equal(intrinsics["CAM_BACK"], np.reshape(p, (3, 4))[:, :3])
    place = np.linalg.inv(mounting["CAM_BACK"])[:3, [2, 3]]  # looks back, where it is
    np.testing.assert_allclose(place.T, [[-1, 0, 0], [-2, 0, 1.5]], atol=1e-12)
    assert frame == "vehicle"
    erase, *lines = node.published[1].markers
    assert erase.action == Message.DELETEALL
    assert len(lines) > 10
    assert {line.header.frame_id for line in lines} == {"base_footprint"}
    assert all(len(line.points) == 20 and line.header.stamp.sec == 8 for line in lines)
    assert max(abs(point.x) for line in lines for point in line.points) > 20  # ahead is x
    many = scope["MapElements"].from_polylines(np.zeros((5, 2, 2)), labels=np.arange(5))
    assert len(list(scope["markers"](many, None))) == 5  # of more classes than colours
