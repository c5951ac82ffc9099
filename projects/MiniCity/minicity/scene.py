"""One scene of MiniCity: its drive, pictures, sweeps and records.

A record is a row of a table of nuScenes. A key frame, which nuScenes calls a sample, has pictures,
a LiDAR sweep and annotated objects. Between key frames, the LiDAR takes further sweeps.
"""

import json
import math
from collections import defaultdict
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray

from minicity.can_bus import pose_messages
from minicity.config import MiniCityConfig, make_rng, make_token
from minicity.curves import Array
from minicity.lidar import footprint_array, scan, vehicle_footprints
from minicity.lighting import Lighting, random_lighting
from minicity.meshes import FrozenMesh, Mesh, add_building, add_pole, add_tree
from minicity.paint import make_scene_map
from minicity.renderer import LOWEST_SUN, SceneRenderer
from minicity.rig import (
    CAMERAS,
    CameraMount,
    ego_from_lidar,
    mounted_camera,
    quaternion,
    world_from_ego,
)
from minicity.town import Town
from minicity.traffic import Actor, Drive, make_actors, plan_ego, vary_drive
from minicity.vehicles import Vehicle

SAMPLE_PERIOD_S = 0.5
SCENE_PERIOD_US = 60_000_000  # between the starts of two scenes
GROUND_MARGIN_M = 48.0  # ground beyond the drive
BUILDING_REACH_M = 130.0  # distance of visible buildings from the drive
PLANT_REACH_M = 90.0  # distance of visible trees and poles from the drive
BOX_REACH_M = 55.0  # distance of annotated objects from the LiDAR
BOX_SLACK_M = 0.05  # added to a box on each side when the LiDAR points inside are counted
JPEG_QUALITY = 90
FIRST_TIMESTAMP_US = 1_600_000_000_000_000
Records = dict[str, list[dict[str, Any]]]  # records by the name of their table


@dataclass(frozen=True)
class SceneTask:
    """Description of a scene to make.

    Attributes:
        name: Name of a scene of nuScenes. The split of this name in nuScenes is the scene's split.
        index: Number of the scene in the data set.
        location: Name of the town.
        index_in_town: Number of the street within the town, equal in all passes of the street.
        route: Name of the first scene on this street, whose random numbers choose the drive.
        pass_index: Number of earlier passes of the street.
        expansion: Name of the map expansion file that describes the streets at the time of the
            drive. If streets are repainted after the drive, it is the location with the suffix
            ``.before``, otherwise the location alone.
    """

    name: str
    index: int
    location: str
    index_in_town: int
    route: str
    pass_index: int
    expansion: str


class SceneMaker:
    """Simulator of one scene, which writes the files of the scene and collects its records.

    Args:
        config: Configuration of the data set.
        task: Description of the scene.
        town: Town of the scene.
        root: Folder of the data set.
    """

    def __init__(self, config: MiniCityConfig, task: SceneTask, town: Town, root: Path) -> None:
        self.config = config
        self.task = task
        self.town = town
        self.root = root
        self.records: Records = defaultdict(list)
        # The last sample is at the end of the scene.
        self.duration_s = SAMPLE_PERIOD_S * (config.samples_per_scene - 1)
        self.samples = [self._token("sample", k) for k in range(config.samples_per_scene)]
        # All passes of a street share the random numbers of its first scene (`route`), so that they
        # have one path. `vary_drive` then changes the later passes.
        self.ego: Drive = plan_ego(
            town,
            task.index_in_town,
            duration_s=self.duration_s,
            rng=make_rng(config.seed, task.route, "ego"),
        )
        if task.pass_index > 0:
            self.ego = vary_drive(self.ego, self._rng("pass"))
        self.lighting: Lighting = random_lighting(self._rng("light"))
        self.actors: list[Actor] = make_actors(
            town, self.ego, duration_s=self.duration_s, rng=self._rng("traffic")
        )
        self.renderer = self._make_renderer()
        # Corners and heights of all buildings, as the LiDAR takes them. (n, 9)
        self.building_boxes = footprint_array(
            footprints=[building.footprint for building in town.buildings],
            heights=[building.height_m for building in town.buildings],
        )
        self.tilt_phases_rad = self._rng("tilt").uniform(low=0, high=2 * np.pi, size=2)

    def _rng(self, *parts: object) -> np.random.Generator:
        """Random generator that depends only on the seed, the scene and ``parts``."""
        return make_rng(self.config.seed, self.task.name, *parts)

    def _token(self, *parts: object) -> str:
        """Token of a record, which depends only on the seed, the scene and ``parts``."""
        return make_token(self.config.seed, self.task.name, *parts)

    def _add(self, table: str, **record: Any) -> None:
        """Add a record to a table."""
        self.records[table].append(record)

    def _make_renderer(self) -> SceneRenderer:
        """Create the renderer of the ground and of the objects around the drive."""
        # Cameras are exposed shortly before their key frame, so the track begins before time 0.
        times = np.linspace(-0.1, self.duration_s, num=12).tolist()
        track = np.array([self.ego.pose(t)[:2] for t in times])
        # Bounds of the ground in the world in metres.
        xmin, ymin = (track.min(axis=0) - GROUND_MARGIN_M).tolist()
        xmax, ymax = (track.max(axis=0) + GROUND_MARGIN_M).tolist()
        bounds = (xmin, ymin, xmax, ymax)
        mesh, shadows = _make_surroundings(self.town, track, lighting=self.lighting)
        # Pixel size of the texture of the ground. It is 6.25 cm for pictures of 800 columns, and
        # coarser for smaller pictures, which need no fine texture.
        resolution_m = np.clip(0.0625 * 800 / self.config.image_width, 0.05, 0.09)
        return SceneRenderer(
            make_scene_map(self.town, bounds),
            bounds=bounds,
            lighting=self.lighting,
            resolution_m=float(resolution_m),
            rng=self._rng("ground"),
            static=mesh,
            shadows=shadows,
        )

    def ego_pose(self, time_s: float) -> Array:
        """Pose of the car at a time in seconds, with slight pitch and roll. (4, 4)"""
        x, y, yaw = self.ego.pose(time_s)
        # Amplitudes in radians, frequencies in radians per second.
        pitch = 0.004 * np.sin(2.1 * time_s + self.tilt_phases_rad[0])
        roll = 0.003 * np.sin(1.3 * time_s + self.tilt_phases_rad[1])
        return world_from_ego(x, y, yaw=yaw, pitch=float(pitch), roll=float(roll))

    def make(self) -> Records:
        """Write all files of the scene.

        Returns:
            Records of the scene by table.

        Raises:
            OSError: If a file cannot be written.
        """
        self._add_scene()
        last = len(self.samples) - 1
        for k, token in enumerate(self.samples):
            time_s = k * SAMPLE_PERIOD_S
            self._add(
                "sample",
                token=token,
                timestamp=self.timestamp_us(time_s),
                prev=self.samples[k - 1] if k > 0 else "",
                next=self.samples[k + 1] if k < last else "",
                scene_token=self._token("scene"),
            )
            for mount in CAMERAS:
                self._take_picture(k, mount)
            cloud = self._sweep(k, j=0)  # sweep 0 is taken at the key frame
            self._annotate(k, cloud)
            if k < last:
                for j in range(1, self.config.sweeps_per_sample + 1):
                    self._sweep(k, j)
        # Neighbours in time are known only now.
        self._link_lidar()
        self._link_annotations()
        start_us = self.timestamp_us(0.0)
        messages = pose_messages(self.ego_pose, start_us, duration_s=self.duration_s)
        path = self.root / "can_bus" / f"{self.task.name}_pose.json"
        path.write_text(json.dumps(messages))
        return dict(self.records)

    def timestamp_us(self, time_s: float) -> int:
        """Timestamp of nuScenes, in microseconds, of a time in seconds since the scene's start."""
        return FIRST_TIMESTAMP_US + self.task.index * SCENE_PERIOD_US + round(time_s * 1e6)

    def _add_scene(self) -> None:
        """Add the log and scene records."""
        # A field that nuScenes does not have: the map of the streets before they are repainted.
        expansion = {}
        if self.task.expansion != self.task.location:
            expansion["map_expansion"] = self.task.expansion
        self._add(
            "log",
            token=self._token("log"),
            logfile=f"minicity-{self.config.seed}-{self.task.name}",
            vehicle="minicity",
            date_captured="2020-09-13",
            location=self.task.location,
            **expansion,
        )
        self._add(
            "scene",
            token=self._token("scene"),
            log_token=self._token("log"),
            nbr_samples=len(self.samples),
            first_sample_token=self.samples[0],
            last_sample_token=self.samples[-1],
            name=self.task.name,
            description=f"MiniCity, {self.lighting.weather}",
        )

    def _add_data(self, channel: str, time_s: float, **data: Any) -> None:
        """Add a ``sample_data`` record, and an ``ego_pose`` record with equal token and time.

        Args:
            channel: Channel of the sensor in nuScenes.
            time_s: Time of the data since the scene's start, in seconds.
            data: Further fields of the ``sample_data`` record, with its ``token``.
        """
        pose = self.ego_pose(time_s)
        token = data["token"]
        timestamp = self.timestamp_us(time_s)
        self._add(
            "ego_pose",
            token=token,
            timestamp=timestamp,
            rotation=quaternion(pose),
            translation=pose[:3, 3].tolist(),
        )
        self._add(
            "sample_data",
            **data,
            ego_pose_token=token,
            calibrated_sensor_token=make_token(self.config.seed, "calibration", channel),
            timestamp=timestamp,
        )

    def _take_picture(self, k: int, mount: CameraMount) -> None:
        """Render and write a picture of key frame ``k``."""
        channel = mount.channel
        time_s = k * SAMPLE_PERIOD_S + mount.delay_ms * 1e-3
        width = self.config.image_width
        height = self.config.image_height
        camera = mounted_camera(mount, width, height=height, ego_pose=self.ego_pose(time_s))
        vehicles = [actor.at(time_s) for actor in self.actors]
        rng = self._rng("picture", k, channel)
        image = self.renderer.render_camera(camera, vehicles, rng=rng)
        name = f"samples/{channel}/{self._stem(channel, time_s)}.jpg"
        parameters = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
        if not cv2.imwrite(str(self.root / name), image, params=parameters):
            raise OSError(f"could not write {self.root / name}: is the disk full?")
        last = len(self.samples) - 1
        self._add_data(
            channel,
            time_s,
            token=self._token("data", channel, k),
            sample_token=self.samples[k],
            fileformat="jpg",
            is_key_frame=True,
            height=height,
            width=width,
            filename=name,
            prev=self._token("data", channel, k - 1) if k > 0 else "",
            next=self._token("data", channel, k + 1) if k < last else "",
        )

    def _stem(self, channel: str, time_s: float) -> str:
        """File name of a sensor's data, without the suffix."""
        return f"minicity-{self.task.name}__{channel}__{self.timestamp_us(time_s)}"

    def _sweep(self, k: int, j: int) -> NDArray[np.float32]:
        """Simulate and write a sweep.

        Args:
            k: Number of the latest key frame at or before the time of the sweep.
            j: Number of the sweep, counted from 0 at this key frame.

        Returns:
            Points in the LiDAR frame, as in the files of nuScenes. (N, 5)
        """
        time_s = (k + j / (self.config.sweeps_per_sample + 1)) * SAMPLE_PERIOD_S
        vehicles = vehicle_footprints([actor.at(time_s) for actor in self.actors])
        cloud = scan(
            world_from_lidar=self.ego_pose(time_s) @ ego_from_lidar(),
            texture=self.renderer.texture,
            boxes=np.concatenate([vehicles, self.building_boxes]),
            rng=self._rng("sweep", k, j),
        )
        is_key_frame = j == 0
        folder = "samples" if is_key_frame else "sweeps"
        name = f"{folder}/LIDAR_TOP/{self._stem('LIDAR_TOP', time_s)}.pcd.bin"
        cloud.tofile(self.root / name)
        # nuScenes assigns a sweep between two key frames to the sample of the second one.
        next_key_frame = k if is_key_frame else k + 1
        self._add_data(
            "LIDAR_TOP",
            time_s,
            token=self._token("data", "LIDAR_TOP", k, j),
            sample_token=self.samples[next_key_frame],
            fileformat="pcd",
            is_key_frame=is_key_frame,
            height=0,
            width=0,
            filename=name,
            prev="",
            next="",
        )
        return cloud

    def _link_lidar(self) -> None:
        """Chain the LiDAR records of key frames and sweeps by time."""
        sweeps = [d for d in self.records["sample_data"] if "LIDAR_TOP" in d["filename"]]
        sweeps.sort(key=lambda d: d["timestamp"])
        _chain(sweeps)

    def _annotate(self, k: int, cloud: NDArray[np.float32]) -> None:
        """Add a box for each vehicle and person that has LiDAR points in key frame ``k``.

        Args:
            k: Number of the key frame.
            cloud: Its sweep, with (x, y, z) in metres in the LiDAR frame first. (N, 5)
        """
        time_s = k * SAMPLE_PERIOD_S
        pose = self.ego_pose(time_s) @ ego_from_lidar()
        points = cloud[:, :3] @ pose[:3, :3].T + pose[:3, 3]
        for actor in self.actors:
            vehicle = actor.at(time_s)
            # The LiDAR is at the origin of `pose`.
            if np.linalg.norm(vehicle.center[:2] - pose[:2, 3]) > BOX_REACH_M:
                continue
            num_points = _points_in_box(points, vehicle)
            if num_points == 0:
                continue
            length, width, height = vehicle.size
            half_turn = vehicle.yaw_rad / 2  # for the quaternion (w, x, y, z) of a rotation about z
            self._add(
                "sample_annotation",
                token=self._token("annotation", vehicle.identity, k),
                sample_token=self.samples[k],
                instance_token=self._token("instance", vehicle.identity),
                visibility_token="4",  # fully visible, in the terms of nuScenes
                attribute_tokens=[make_token("attribute", _attribute(vehicle))],
                translation=vehicle.center.tolist(),
                size=[width, length, height],  # the order of nuScenes
                rotation=[math.cos(half_turn), 0.0, 0.0, math.sin(half_turn)],
                prev="",
                next="",
                num_lidar_pts=num_points,
                num_radar_pts=0,
                category=vehicle.category,  # only for the instance record
            )

    def _link_annotations(self) -> None:
        """Chain the boxes of each instance and add the instance records."""
        by_instance: dict[str, list[dict[str, Any]]] = defaultdict(list)
        for box in self.records["sample_annotation"]:
            by_instance[box["instance_token"]].append(box)
        for token, boxes in by_instance.items():
            _chain(boxes)
            self._add(
                "instance",
                token=token,
                category_token=make_token("category", boxes[0]["category"]),
                nbr_annotations=len(boxes),
                first_annotation_token=boxes[0]["token"],
                last_annotation_token=boxes[-1]["token"],
            )
        for box in self.records["sample_annotation"]:  # the tables of nuScenes have no such field
            del box["category"]


def _chain(records: list[dict[str, Any]]) -> None:
    """Link consecutive records by their ``prev`` and ``next`` fields, in place."""
    for before, after in pairwise(records):
        before["next"] = after["token"]
        after["prev"] = before["token"]


def _attribute(vehicle: Vehicle) -> str:
    """Attribute name in nuScenes of a vehicle or person."""
    if vehicle.category.startswith("human"):
        return "pedestrian.standing"
    return "vehicle.moving" if vehicle.speed > 0 else "vehicle.parked"


def _points_in_box(points: Array, vehicle: Vehicle) -> int:
    """Number of points (N, 3) in the world, in metres, inside the box of a vehicle."""
    dx = points[:, 0] - vehicle.center[0]
    dy = points[:, 1] - vehicle.center[1]
    dz = points[:, 2] - vehicle.center[2]
    # Only points near the box are rotated. A point inside is at most half of the diagonal from the
    # centre, and this is shorter than the length of the box.
    near = (np.abs(dx) < vehicle.size[0]) & (np.abs(dy) < vehicle.size[0])
    dx = dx[near]
    dy = dy[near]
    c = np.cos(vehicle.yaw_rad)
    s = np.sin(vehicle.yaw_rad)
    local = np.stack([c * dx + s * dy, c * dy - s * dx, dz[near]], axis=1)
    inside = (np.abs(local) <= np.array(vehicle.size) / 2 + BOX_SLACK_M).all(axis=1)
    return int(inside.sum())


def _make_surroundings(
    town: Town, track: Array, lighting: Lighting
) -> tuple[FrozenMesh, list[Array]]:
    """Create the mesh and the shadows of the buildings, trees and poles near a drive.

    Args:
        town: The town.
        track: Positions of the ego vehicle in metres. (T, 2)
        lighting: Direction of the sun, strength of shadows and weather.

    Returns:
        The mesh, and the outlines of shadows on the ground in metres. Each outline is (n, 2). There
        are no outlines if the lighting has no shadows.
    """
    mesh = Mesh()
    shadows = []
    # Shift of the shadow of a point per metre of its height. `LOWEST_SUN` is the smallest sine of
    # the sun's elevation that is used, which limits the length of shadows.
    shadow_shift = -lighting.sun[:2] / max(float(lighting.sun[2]), LOWEST_SUN)

    def track_distance(points: Array) -> Array:
        """Distance of points (n, 2) from the track in metres. (n,)"""
        return np.linalg.norm(points[:, None] - track[None], axis=-1).min(axis=1)

    if town.buildings:
        centers = np.array([b.footprint.mean(axis=0) for b in town.buildings])
        for i in np.flatnonzero(track_distance(centers) < BUILDING_REACH_M):
            building = town.buildings[i]
            add_building(mesh, building, lit_windows=lighting.weather == "dusk")
            # The shadow is the convex hull of the walls' base and of the shadow of the roof.
            roof_shadow = building.footprint + shadow_shift * building.height_m
            corners = shapely.MultiPoint(np.concatenate([building.footprint, roof_shadow]))
            shadows.append(np.array(corners.convex_hull.exterior.coords))
    angles = np.linspace(0, 2 * np.pi, num=12, endpoint=False)
    circle = np.column_stack([np.cos(angles), np.sin(angles)])
    for tree in town.trees[track_distance(town.trees[:, :2]) < PLANT_REACH_M]:
        add_tree(mesh, tree)
        height = tree[2]  # a tree is (x, y, height) in metres
        # The middle of the crown is at 0.68 of the height of a tree. The shadow of the crown is a
        # disc with a radius of 0.26 of the height.
        shadow_center = tree[:2] + shadow_shift * 0.68 * height
        crown_shadow = shadow_center + 0.26 * height * circle
        shadows.append(crown_shadow)
    for pole in town.poles[track_distance(town.poles[:, :2]) < PLANT_REACH_M]:
        add_pole(mesh, pole)
    if lighting.shadow <= 0:
        shadows = []
    return mesh.freeze(), shadows
