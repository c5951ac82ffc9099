"""A small log of py123d, written in its format without the library, and by the library itself."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import shapely

from gsmap.structures.rigid import rigid

TIMES_US = [1_700_000_000_000_000 + 250_000 * number for number in range(5)]
SIZE = (320, 180)
INTRINSICS = [200.0, 210.0, 160.0, 90.0, 0.0]
DISTORTION = [-0.1, 0.01, 0.0, 0.0, 0.0]
EGO = {
    "vehicle_name": "test",
    "width": 2.0,
    "length": 4.0,
    "height": 1.5,
    "wheel_base": 2.5,
    "center_to_imu_se3": [1.0, 0.0, 0.25, 1.0, 0.0, 0.0, 0.0],
    "rear_axle_to_imu_se3": [-0.5, 0.0, -0.1, 1.0, 0.0, 0.0, 0.0],
}
IMU_FROM_CAMERA = [1.5, 0.0, 1.0, 0.5, -0.5, 0.5, -0.5]  # z of the camera ahead, y down
ROAD_LINES = [
    (4, [[0.0, 2.0, 0.1], [100.0, 2.0, 0.1]]),  # dashed white
    (0, [[0.0, -2.0, 0.1], [100.0, -2.0, 0.1]]),  # no paint
]
ROAD_EDGE = [[0.0, -6.0, 0.1], [50.0, -6.0, 0.1]]
SECOND_EDGE = [[50.0, -6.0, 0.1], [100.0, -6.0, 0.1]]
CROSSWALK = [[40.0, -6.0], [44.0, -6.0], [44.0, 6.0], [40.0, 6.0], [40.0, -6.0]]
CENTERLINE = [[0.0, 0.0, 0.1], [100.0, 0.0, 0.1]]
LANE_SIDES = ([[0.0, 2.0, 0.1], [100.0, 2.0, 0.1]], [[0.0, -2.0, 0.1], [100.0, -2.0, 0.1]])


def imu_pose(number: int) -> list[float]:
    """Pose of the IMU at a frame: 2 m ahead of the one before, looking along y. (7,)"""
    return [20.0 + 2.0 * number, 0.0, 0.6, *quaternion_of_yaw(0.0)]


def quaternion_of_yaw(yaw: float) -> list[float]:
    """Quaternion w, x, y, z of a turn about z."""
    return [float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2))]


def jpeg(number: int) -> bytes:
    """Content of an image, of a grey that depends on its number."""
    grey = np.full((SIZE[1], SIZE[0], 3), 40 * number, np.uint8)
    return cv2.imencode(".jpg", grey)[1].tobytes()


def camera_metadata(name: str, number: int, distorted: bool) -> dict[str, Any]:
    """Metadata of a camera."""
    return {
        "camera_model": "pinhole",
        "camera_name": name,
        "camera_id": number,
        "intrinsics": INTRINSICS,
        "distortion": DISTORTION if distorted else None,
        "width": SIZE[0],
        "height": SIZE[1],
        "camera_to_imu_se3": IMU_FROM_CAMERA,
        "is_undistorted": not distorted,
    }


def log_metadata(version: str = "0.7.0") -> dict[str, Any]:
    """Metadata of the log, with those of its map."""
    shared = {"dataset": "test", "location": "town", "version": version}
    split = {"split": "test_val", "log_name": "log1"}
    map_metadata = {**shared, **split, "map_has_z": True, "map_is_per_log": True}
    return {**shared, **split, "map_metadata": map_metadata}


def write_table(path: Path, columns: dict[str, pa.Array], metadata: dict[str, Any]) -> None:
    """Write a table with metadata of py123d."""
    import msgpack

    packed = {b"metadata": msgpack.packb(metadata, use_bin_type=True)}
    table = pa.table(columns).replace_schema_metadata(packed)
    with pa.ipc.new_file(str(path), table.schema) as writer:
        writer.write_table(table)


def write_log(root: Path) -> Path:
    """Write a log with two cameras, whose images are files and bytes, and its map; its folder."""
    folder = root / "logs/test_val/log1"
    folder.mkdir(parents=True)
    times = pa.array(TIMES_US, pa.int64())
    rows = pa.array(range(len(TIMES_US)), pa.int64())
    poses = pa.list_(pa.float64(), 7)
    ego = {
        "ego_state_se3.timestamp_us": times,
        "ego_state_se3.imu_se3": pa.array([imu_pose(i) for i in range(5)], poses),
    }
    write_table(folder / "ego_state_se3.arrow", ego, EGO)
    paths = []
    for number in range(len(TIMES_US)):
        path = root / f"front/{number}.jpg"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(jpeg(number))
        paths.append(f"front/{number}.jpg")
    contents = [jpeg(number) for number in range(len(TIMES_US))]
    data = {"pcam_f0": pa.array(paths), "pcam_b0": pa.array(contents, pa.binary())}
    for number, (name, values) in enumerate(data.items()):
        key = f"camera.{name}"
        stored = [global_pose_of_camera(i) if number else None for i in range(5)]
        columns = {
            f"{key}.timestamp_us": times,
            f"{key}.data": values,
            f"{key}.camera_to_global_se3": pa.array(stored, poses),
        }
        metadata = camera_metadata(name, number=number, distorted=number == 1)
        write_table(folder / f"{key}.arrow", columns, metadata)
    sync = {
        "sync.timestamp_us": times,
        "ego_state_se3": rows,
        "camera.pcam_f0": rows,
        "camera.pcam_b0": pa.array([0, 1, 2, 3, None], pa.int64()),
    }
    write_table(folder / "sync.arrow", sync, log_metadata())
    write_map(folder / "map.arrow")
    return folder


def global_pose_of_camera(number: int) -> list[float]:
    """Pose of a camera at a frame; the IMU does not turn. (7,)"""
    imu = imu_pose(number)
    return [imu[axis] + IMU_FROM_CAMERA[axis] for axis in range(3)] + IMU_FROM_CAMERA[3:]


def global_from_axle(number: int) -> np.ndarray:
    """Pose of the rear axle at a frame. (4, 4)"""
    position = np.add(imu_pose(number)[:3], EGO["rear_axle_to_imu_se3"][:3])
    return rigid(np.eye(3), position)


def packed_array(points: Any) -> dict[bytes, Any]:
    """Points as py123d stores arrays in MessagePack."""
    values = np.asarray(points, dtype=np.float64)
    content = {b"dtype": values.dtype.str, b"shape": values.shape, b"data": values.tobytes()}
    return {b"__ndarray__": True, **content}


def write_map(path: Path) -> None:
    """Write the map of the log."""
    import msgpack

    rows: list[tuple[int, dict, shapely.Geometry]] = []
    lane = {"centerline": packed_array(CENTERLINE)}
    area = shapely.Polygon([*LANE_SIDES[0], *LANE_SIDES[1][::-1]])
    rows.append((0, lane, area))
    rows.append((3, {}, shapely.Polygon(CROSSWALK)))
    for edge in (ROAD_EDGE, SECOND_EDGE):
        rows.append((8, {"road_edge_type": 1}, shapely.LineString(edge)))
    for kind, line in ROAD_LINES:
        rows.append((9, {"road_line_type": kind}, shapely.LineString(line)))
    columns = {
        "object_id": pa.array(range(len(rows)), pa.int64()),
        "map_layer": pa.array([layer for layer, _, _ in rows], pa.int8()),
        "features": pa.array([msgpack.packb(features) for _, features, _ in rows], pa.binary()),
        "wkb": pa.array([geometry.wkb for _, _, geometry in rows], pa.binary()),
    }
    write_table(path, columns, log_metadata()["map_metadata"])


def write_log_by_the_library(root: Path) -> Path:
    """Write the log of `write_log` with py123d; its folder."""
    from py123d.api.map.arrow.arrow_map_writer import ArrowMapWriter
    from py123d.api.scene.arrow.arrow_log_writer import ArrowLogWriter
    from py123d.api.scene.arrow.utils.log_writer_config import LogWriterConfig
    from py123d.datatypes import (
        Crosswalk,
        Lane,
        LaneType,
        LogMetadata,
        MapMetadata,
        RoadEdge,
        RoadEdgeType,
        RoadLine,
        RoadLineType,
    )
    from py123d.datatypes.sensors.pinhole_camera import PinholeCameraMetadata
    from py123d.datatypes.time.timestamp import Timestamp
    from py123d.datatypes.vehicle_state.ego_state import EgoStateSE3
    from py123d.datatypes.vehicle_state.ego_state_metadata import EgoStateSE3Metadata
    from py123d.geometry import Polyline3D, PoseSE3
    from py123d.parser.base_dataset_parser import ModalitiesSync, ParsedCamera

    map_metadata = MapMetadata.from_dict(log_metadata()["map_metadata"])
    maps = ArrowMapWriter(True, maps_root=root / "maps", logs_root=root / "logs")
    maps.reset(map_metadata)
    left, right = (Polyline3D.from_array(np.array(side)) for side in LANE_SIDES)
    centre = Polyline3D.from_array(np.array(CENTERLINE))
    maps.write_map_object(Lane(0, LaneType(2), left, right, centre))
    maps.write_map_object(Crosswalk(0, shapely_polygon=shapely.Polygon(CROSSWALK)))
    for number, edge in enumerate((ROAD_EDGE, SECOND_EDGE)):
        line = Polyline3D.from_array(np.array(edge))
        maps.write_map_object(RoadEdge(number, RoadEdgeType(1), line))
    for number, (kind, points) in enumerate(ROAD_LINES):
        line = Polyline3D.from_array(np.array(points))
        maps.write_map_object(RoadLine(number, RoadLineType(kind), line))
    maps.close()

    folder = root / "logs/test_val/log1"
    for number, (name, option) in enumerate([("pcam_f0", "path"), ("pcam_b0", "jpeg_binary")]):
        config = LogWriterConfig(
            force_log_conversion=True, camera_store_option=option, write_route=False
        )
        writer = ArrowLogWriter(config, logs_root=root / "logs", sensors_root=root)
        writer.reset(LogMetadata.from_dict(log_metadata()))
        metadata = camera_metadata(name, number=number, distorted=number == 1)
        camera = PinholeCameraMetadata.from_dict(metadata)
        ego = EgoStateSE3Metadata.from_dict(EGO)
        for frame, time in enumerate(TIMES_US):
            at = Timestamp.from_us(time)
            modalities: list[Any] = [
                EgoStateSE3.from_imu(PoseSE3.from_list(imu_pose(frame)), ego, at)
            ]
            pose = PoseSE3.from_list(global_pose_of_camera(frame)) if number else None
            if option == "path":
                path = root / f"front/{frame}.jpg"
                path.parent.mkdir(exist_ok=True)
                path.write_bytes(jpeg(frame))
                image = {"dataset_root": root, "relative_path": f"front/{frame}.jpg"}
            else:
                image = {"byte_string": jpeg(frame)}
            modalities.append(ParsedCamera(camera, at, pose, **image))
            writer.write_sync(ModalitiesSync(at, modalities))
        writer.close()
        (folder / "sync.arrow").rename(folder / f"sync_{number}")
    first = pa.ipc.open_file(str(folder / "sync_0")).read_all()
    second = pa.ipc.open_file(str(folder / "sync_1")).read_all()
    both = first.append_column("camera.pcam_b0", second["camera.pcam_b0"])
    with pa.ipc.new_file(str(folder / "sync.arrow"), both.schema) as file:
        file.write_table(both)
    for number in range(2):
        (folder / f"sync_{number}").unlink()
    return folder
