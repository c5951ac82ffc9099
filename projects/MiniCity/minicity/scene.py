"""One scene of MiniCity: drives it, takes its pictures and sweeps, and writes its records."""

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
from minicity.renderer import SceneRenderer
from minicity.rig import (
    CAMERAS,
    CameraMount,
    ego_from_lidar,
    mounted_camera,
    quaternion,
    world_from_ego,
)
from minicity.town import Town
from minicity.traffic import Actor, Drive, make_actors, plan_ego
from minicity.vehicles import Vehicle

SAMPLE_PERIOD_S = 0.5
GROUND_MARGIN_M = 48.0
BOX_REACH_M = 55.0
BOX_SLACK_M = 0.05
JPEG_QUALITY = 90
FIRST_TIMESTAMP_US = 1_600_000_000_000_000
Records = dict[str, list[dict[str, Any]]]


@dataclass(frozen=True)
class SceneTask:
    """What a worker needs to know to make a scene.

    Attributes:
        name: Official nuScenes scene name, which decides its split.
        index: Number of the scene in the data set.
        location: Town in which it is driven.
        index_in_town: Number of the scene within its town.
    """

    name: str
    index: int
    location: str
    index_in_town: int


class SceneMaker:
    """Makes one scene.

    Args:
        config: The data set's configuration.
        task: Which scene.
        town: Its town.
        root: Folder that the files go to.
    """

    def __init__(self, config: MiniCityConfig, task: SceneTask, town: Town, root: Path) -> None:
        self.config, self.task, self.town, self.root = config, task, town, root
        self.records: Records = defaultdict(list)
        self.duration_s = SAMPLE_PERIOD_S * (config.samples_per_scene - 1)
        self.ego: Drive = plan_ego(town, task.index_in_town, self.duration_s, self._rng("ego"))
        self.lighting: Lighting = random_lighting(self._rng("light"))
        self.actors: list[Actor] = make_actors(
            town, self.ego, self.duration_s, self._rng("traffic")
        )
        self.renderer = self._make_renderer()
        footprints = [b.footprint for b in town.buildings]
        self.walls = footprint_array(footprints, [b.height_m for b in town.buildings])
        self.tilt_rad = self._rng("tilt").uniform(0, 2 * np.pi, 2)

    def _rng(self, *parts: object) -> np.random.Generator:
        return make_rng(self.config.seed, self.task.name, *parts)

    def _token(self, *parts: object) -> str:
        return make_token(self.config.seed, self.task.name, *parts)

    def _add(self, table: str, **record: Any) -> None:
        self.records[table].append(record)

    def _make_renderer(self) -> SceneRenderer:
        times = np.linspace(-0.1, self.duration_s, 12)
        track = np.array([self.ego.pose(float(t))[:2] for t in times])
        low, high = track.min(0) - GROUND_MARGIN_M, track.max(0) + GROUND_MARGIN_M
        bounds = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
        resolution = float(np.clip(0.0625 * 800 / self.config.image_width, 0.05, 0.09))
        mesh, shadows = _surroundings(self.town, track, self.lighting)
        scene_map = make_scene_map(self.town, bounds)
        return SceneRenderer(
            scene_map, bounds, self.lighting, resolution, self._rng("ground"), mesh, shadows
        )

    def ego_pose(self, time_s: float) -> Array:
        """Pose of the car, nodding and rolling a little. (4, 4)"""
        pitch = 0.004 * np.sin(2.1 * time_s + self.tilt_rad[0])
        roll = 0.003 * np.sin(1.3 * time_s + self.tilt_rad[1])
        return world_from_ego(*self.ego.pose(time_s), float(pitch), float(roll))

    def make(self) -> Records:
        """Write all files of the scene and return its records by table."""
        samples = [self._token("sample", k) for k in range(self.config.samples_per_scene)]
        self._add_scene(samples)
        for k, token in enumerate(samples):
            time_s = k * SAMPLE_PERIOD_S
            self._add(
                "sample",
                token=token,
                timestamp=self.timestamp_us(time_s),
                prev=samples[k - 1] if k else "",
                next=samples[k + 1] if k + 1 < len(samples) else "",
                scene_token=self._token("scene"),
            )
            for mount in CAMERAS:
                self._take_picture(k, mount, samples)
            cloud = self._sweep(k, 0, samples)
            self._annotate(k, token, cloud)
            if k + 1 < len(samples):
                for j in range(1, self.config.sweeps_per_sample + 1):
                    self._sweep(k, j, samples)
        self._link_lidar()
        self._link_annotations()
        messages = pose_messages(self.ego_pose, self.timestamp_us(0.0), self.duration_s)
        path = self.root / "can_bus" / f"{self.task.name}_pose.json"
        path.write_text(json.dumps(messages))
        return dict(self.records)

    def timestamp_us(self, time_s: float) -> int:
        """Time since the scene's start as a nuScenes timestamp."""
        return FIRST_TIMESTAMP_US + self.task.index * 60_000_000 + round(time_s * 1e6)

    def _add_scene(self, samples: list[str]) -> None:
        self._add(
            "log",
            token=self._token("log"),
            logfile=f"minicity-{self.config.seed}-{self.task.name}",
            vehicle="minicity",
            date_captured="2020-09-13",
            location=self.task.location,
        )
        self._add(
            "scene",
            token=self._token("scene"),
            log_token=self._token("log"),
            nbr_samples=len(samples),
            first_sample_token=samples[0],
            last_sample_token=samples[-1],
            name=self.task.name,
            description=f"MiniCity, {self.lighting.weather}",
        )

    def _add_data(self, channel: str, time_s: float, **data: Any) -> None:
        """Add a sample_data record and the ego pose of its moment."""
        pose, token, timestamp = self.ego_pose(time_s), data["token"], self.timestamp_us(time_s)
        rotation, translation = quaternion(pose), pose[:3, 3].tolist()
        moment = {"token": token, "timestamp": timestamp}
        self._add("ego_pose", **moment, rotation=rotation, translation=translation)
        self._add(
            "sample_data",
            **data,
            ego_pose_token=token,
            calibrated_sensor_token=make_token(self.config.seed, "calibration", channel),
            timestamp=timestamp,
        )

    def _take_picture(self, k: int, mount: CameraMount, samples: list[str]) -> None:
        channel = mount.channel
        time_s = k * SAMPLE_PERIOD_S + mount.delay_ms * 1e-3
        width, height = self.config.image_width, self.config.image_height
        camera = mounted_camera(mount, width, height, self.ego_pose(time_s))
        vehicles = [actor.at(time_s) for actor in self.actors]
        image = self.renderer.render_camera(camera, vehicles, self._rng("picture", k, channel))
        name = f"samples/{channel}/{self._stem(channel, time_s)}.jpg"
        parameters = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
        if not cv2.imwrite(str(self.root / name), image, parameters):
            raise OSError(f"could not write {self.root / name}: is the disk full?")
        self._add_data(
            channel,
            time_s,
            token=self._token("data", channel, k),
            sample_token=samples[k],
            fileformat="jpg",
            is_key_frame=True,
            height=height,
            width=width,
            filename=name,
            prev=self._token("data", channel, k - 1) if k else "",
            next=self._token("data", channel, k + 1) if k + 1 < len(samples) else "",
        )

    def _stem(self, channel: str, time_s: float) -> str:
        return f"minicity-{self.task.name}__{channel}__{self.timestamp_us(time_s)}"

    def _sweep(self, k: int, j: int, samples: list[str]) -> NDArray[np.float32]:
        """Write sweep ``j`` after key frame ``k``; number 0 is the key frame's own. (N, 5)"""
        time_s = (k + j / (self.config.sweeps_per_sample + 1)) * SAMPLE_PERIOD_S
        boxes = np.concatenate(
            [vehicle_footprints([a.at(time_s) for a in self.actors]), self.walls]
        )
        pose = self.ego_pose(time_s) @ ego_from_lidar()
        cloud = scan(pose, self.renderer.texture, boxes, self._rng("sweep", k, j))
        folder = "samples" if j == 0 else "sweeps"
        name = f"{folder}/LIDAR_TOP/{self._stem('LIDAR_TOP', time_s)}.pcd.bin"
        cloud.tofile(self.root / name)
        self._add_data(
            "LIDAR_TOP",
            time_s,
            token=self._token("data", "LIDAR_TOP", k, j),
            sample_token=samples[k if j == 0 else k + 1],
            fileformat="pcd",
            is_key_frame=j == 0,
            height=0,
            width=0,
            filename=name,
            prev="",
            next="",
        )
        return cloud

    def _link_lidar(self) -> None:
        sweeps = [d for d in self.records["sample_data"] if "LIDAR_TOP" in d["filename"]]
        sweeps.sort(key=lambda d: d["timestamp"])
        for before, after in pairwise(sweeps):
            before["next"], after["prev"] = after["token"], before["token"]

    def _annotate(self, k: int, sample: str, cloud: NDArray[np.float32]) -> None:
        time_s = k * SAMPLE_PERIOD_S
        pose = self.ego_pose(time_s) @ ego_from_lidar()
        points = cloud[:, :3] @ pose[:3, :3].T + pose[:3, 3]
        for vehicle in (actor.at(time_s) for actor in self.actors):
            if np.linalg.norm(vehicle.center[:2] - pose[:2, 3]) > BOX_REACH_M:
                continue
            struck = _points_in_box(points, vehicle)
            if not struck:
                continue
            length, width, height = vehicle.size
            half_turn = vehicle.yaw_rad / 2
            person = vehicle.category.startswith("human")
            state = "standing" if person else ("moving" if vehicle.speed > 0 else "parked")
            attribute = f"{'pedestrian' if person else 'vehicle'}.{state}"
            self._add(
                "sample_annotation",
                token=self._token("annotation", vehicle.identity, k),
                sample_token=sample,
                instance_token=self._token("instance", vehicle.identity),
                visibility_token="4",
                attribute_tokens=[make_token("attribute", attribute)],
                translation=vehicle.center.tolist(),
                size=[width, length, height],
                rotation=[math.cos(half_turn), 0.0, 0.0, math.sin(half_turn)],
                prev="",
                next="",
                num_lidar_pts=struck,
                num_radar_pts=0,
                category=vehicle.category,
            )

    def _link_annotations(self) -> None:
        """Chain the boxes of each instance and write the instance table."""
        by_instance: dict[str, list[dict[str, Any]]] = defaultdict(list)
        for box in self.records["sample_annotation"]:
            by_instance[box["instance_token"]].append(box)
        for token, boxes in by_instance.items():
            for before, after in pairwise(boxes):
                before["next"], after["prev"] = after["token"], before["token"]
            self._add(
                "instance",
                token=token,
                category_token=make_token("category", boxes[0]["category"]),
                nbr_annotations=len(boxes),
                first_annotation_token=boxes[0]["token"],
                last_annotation_token=boxes[-1]["token"],
            )
        for box in self.records["sample_annotation"]:
            del box["category"]


def _points_in_box(points: Array, vehicle: Vehicle) -> int:
    dx, dy = points[:, 0] - vehicle.center[0], points[:, 1] - vehicle.center[1]
    near = (np.abs(dx) < vehicle.size[0]) & (np.abs(dy) < vehicle.size[0])
    dx, dy, dz = dx[near], dy[near], points[near, 2] - vehicle.center[2]
    c, s = np.cos(vehicle.yaw_rad), np.sin(vehicle.yaw_rad)
    local = np.stack([c * dx + s * dy, c * dy - s * dx, dz], axis=1)
    return int((np.abs(local) <= np.array(vehicle.size) / 2 + BOX_SLACK_M).all(1).sum())


def _surroundings(town: Town, track: Array, lighting: Lighting) -> tuple[FrozenMesh, list[Array]]:
    """What stands near the drive, and the shadows that it casts."""
    mesh, shadows = Mesh(), []
    cast = -lighting.sun[:2] / max(float(lighting.sun[2]), 0.2)

    def reach(points: Array) -> Array:
        return np.linalg.norm(points[:, None] - track[None], axis=-1).min(1)

    if town.buildings:
        centers = np.array([b.footprint.mean(0) for b in town.buildings])
        for i in np.flatnonzero(reach(centers) < 130):
            building = town.buildings[i]
            add_building(mesh, building, lighting.weather == "dusk")
            both = np.concatenate(
                [building.footprint, building.footprint + cast * building.height_m]
            )
            shadows.append(np.array(shapely.MultiPoint(both).convex_hull.exterior.coords))
    turn = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    ring = np.column_stack([np.cos(turn), np.sin(turn)])
    for tree in town.trees[reach(town.trees[:, :2]) < 90]:
        add_tree(mesh, tree)
        shadows.append(tree[:2] + cast * 0.68 * tree[2] + 0.26 * tree[2] * ring)
    for pole in town.poles[reach(town.poles[:, :2]) < 90]:
        add_pole(mesh, pole)
    return mesh.freeze(), shadows if lighting.shadow > 0 else []
