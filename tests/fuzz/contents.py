"""One sample as the files of other programs and of users hold it, for the readers of such files."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.datasets.annotations.file import SHARD_KIND as ANNOTATIONS
from gsmap.datasets.annotations.file import write_annotations
from gsmap.datasets.annotations.record import CLASSES, AnnotationMeta, MapSample
from gsmap.datasets.elements import elements_of_instances
from gsmap.evaluation.core.evaluator import MapEvaluator
from gsmap.evaluation.core.match_files import write_matches
from gsmap.evaluation.core.metric import MetricSettings
from gsmap.evaluation.core.results_json import SHARD_KIND as RESULTS
from gsmap.evaluation.core.results_json import vectors_of, write_results
from gsmap.structures.grid import BEVGrid
from gsmap.utils.shards import Shard
from minicity.repaint import Change, changes_geojson


def info_v2(sample: MapSample) -> dict[str, Any]:
    """Return mmdet3d's info file of a sample."""
    images = {}
    for camera in sample.cameras:
        images[camera.name] = {
            "img_path": camera.path,
            "cam2img": camera.intrinsics.tolist(),
            "lidar2cam": camera.cam_from_frame.tolist(),
        }
    lidar = {"lidar2ego": sample.ego_from_frame.tolist(), "lidar_path": sample.lidar.path}
    pose = sample.global_from_frame @ np.linalg.inv(sample.ego_from_frame)
    entry = {"token": "t", "timestamp": 1.5, "images": images, "lidar_points": lidar,
             "ego2global": pose, "sample_idx": 0}  # fmt: skip
    return {"metainfo": {}, "data_list": [entry]}


def info_of_maptr(sample: MapSample) -> dict[str, Any]:
    """Return an info file with the ground truth of a sample."""

    def sensor(path: str, frame_from_sensor: np.ndarray) -> dict[str, Any]:
        return {
            "data_path": path,
            "sensor2lidar_rotation": frame_from_sensor[:3, :3],
            "sensor2lidar_translation": frame_from_sensor[:3, 3].tolist(),
            "timestamp": 5,
        }

    lines: dict[str, list[Any]] = {name: [] for name in CLASSES}
    for instance in sample.instances:
        lines[CLASSES[instance.label]].append(instance.points.astype(float).tolist())
    sweeps = [sensor(sweep.path, sweep.frame_from_lidar) for sweep in sample.lidar.sweeps]
    cameras = {}
    for camera in sample.cameras:
        cameras[camera.name] = sensor(camera.path, np.linalg.inv(camera.cam_from_frame))
        cameras[camera.name]["cam_intrinsic"] = camera.intrinsics.tolist()
    entry = {
        "token": "t", "timestamp": 7, "map_location": "town", "scene_token": "s",
        "lidar_path": sample.lidar.path, "can_bus": np.zeros(18), "annotation": lines,
        "lidar2ego_translation": [0.0, 0.0, 1.8], "lidar2ego_rotation": [1.0, 0.0, 0.0, 0.0],
        "ego2global_translation": [5.0, 6.0, 0.0], "ego2global_rotation": [1.0, 0.0, 0.0, 0.0],
        "sweeps": sweeps, "cams": cameras,
    }  # fmt: skip
    return {"infos": [entry], "metadata": {"version": "x"}}


def info_of_argoverse2(sample: MapSample) -> dict[str, Any]:
    """Return an info file of a sample of Argoverse 2."""
    turn = {"e2g_translation": [5.0, 6.0, 0.0], "e2g_rotation": [1.0, 0.0, 0.0, 0.0]}
    lines: dict[str, list[Any]] = {name: [] for name in CLASSES}
    for instance in sample.instances:  # along x, as the range is
        points = instance.points[:, ::-1].astype(float).tolist()
        lines[CLASSES[instance.label]].append(points)
    cameras = {}
    for camera in sample.cameras:
        cameras[camera.name] = {
            "img_fpath": camera.path,
            "intrinsics": camera.intrinsics.tolist(),
            "extrinsics": camera.cam_from_frame.tolist(),
            **turn,
        }
    entry = {"token": "t", "log_id": "l", "timestamp": 7, "lidar_path": sample.lidar.path,
             "cams": cameras, "annotation": lines, **turn}  # fmt: skip
    return {"samples": [entry]}


def exported_model() -> bytes:
    """Return a tiny model with the inputs, outputs and metadata of an exported one."""
    from onnx import TensorProto, helper, numpy_helper

    rng = np.random.default_rng(0)
    weights = {
        "kernel": rng.normal(size=(5, 3, 3, 3)).astype(np.float32),
        "shape": np.array([10, -1]),
        "matrix": rng.normal(size=(8, 4)).astype(np.float32),
        "elements": np.array([10, 2, 2]),
        "classes": np.arange(10) % len(CLASSES),
    }
    nodes = [
        helper.make_node("Conv", ["images", "kernel"], ["features"]),
        helper.make_node("Reshape", ["features", "shape"], ["flat"]),
        helper.make_node("Sigmoid", ["flat"], ["likely"]),
        helper.make_node("MatMul", ["likely", "matrix"], ["corners"]),
        helper.make_node("Reshape", ["corners", "elements"], ["points"]),
        helper.make_node("ReduceMean", ["likely"], ["means"], axes=[1], keepdims=0),
        helper.make_node("ReduceMax", ["img_from_frame"], ["most"], keepdims=0),
        helper.make_node("Div", ["means", "most"], ["scores"]),
        helper.make_node("Identity", ["classes"], ["labels"]),
    ]
    numbers = TensorProto.FLOAT
    inputs = [
        helper.make_tensor_value_info("images", numbers, [2, 3, 4, 6]),
        helper.make_tensor_value_info("img_from_frame", numbers, [2, 4, 4]),
    ]
    outputs = [
        helper.make_tensor_value_info("scores", numbers, [10]),
        helper.make_tensor_value_info("labels", TensorProto.INT64, [10]),
        helper.make_tensor_value_info("points", numbers, [10, 2, 2]),
    ]
    stored = [numpy_helper.from_array(array, name) for name, array in weights.items()]
    graph = helper.make_graph(nodes, "map", inputs, outputs, stored)
    opset = [helper.make_opsetid("", 17)]
    model = helper.make_model(graph, ir_version=8, opset_imports=opset)
    metadata = {
        "format": 1, "image_size": [4, 6], "classes": CLASSES, "x_range": [-15.0, 15.0],
        "y_range": [-30.0, 30.0], "frame": "lidar", "cameras": ["left", "right"],
        "margin_m": 5.0, "score_threshold": None,
    }  # fmt: skip
    helper.set_model_props(model, {"gsmap": json.dumps(metadata)})
    return model.SerializeToString()


def own_calibration(sample: MapSample) -> dict[str, Any]:
    """Return a calibration file for the images of a sample."""
    cameras = {}
    for camera in sample.cameras:
        cameras[camera.name] = {
            "images": camera.path,
            "intrinsics": camera.intrinsics.tolist(),
            "vehicle_from_camera": np.linalg.inv(camera.cam_from_frame).tolist(),
        }
    first = sample.cameras[0].name
    cameras[first]["distortion"] = [-0.2, 0.05, 0.0, 0.0]
    return {"cameras": cameras, "ground_z_m": 0.1}


def own_poses(sample: MapSample) -> bytes:
    """Return a table of poses for the images of a sample."""
    stems = sorted({Path(camera.path).stem for camera in sample.cameras})
    rows = [f"{stem},1.0,2.0,0.0,1.0,0.0,0.0,0.0" for stem in stems]
    return "\n".join(["frame,x,y,z,qw,qx,qy,qz", *rows]).encode()


def changes(map_name: str) -> bytes:
    """Return a file of changes with each kind of a change in a town."""
    line = np.array([[300.0, 300.0], [310.0, 300.0], [320.0, 301.0]])
    ring = np.array([[300.0, 310.0], [308.0, 310.0], [308.0, 313.0], [300.0, 310.0]])
    town = [
        Change(0, "removed", "divider", before=line),
        Change(1, "added", "ped_crossing", after=ring),
        Change(2, "moved", "divider", before=line, after=line + 1),
    ]
    content = changes_geojson({map_name: town})
    content["features"][0]["properties"]["confidence"] = 0.5
    return json.dumps(content).encode()


def own_record(sample: MapSample) -> dict[str, Any]:
    """Return a sample as a plain record."""
    cameras = []
    for camera in sample.cameras:
        record = {
            "name": camera.name,
            "path": camera.path,
            "width": camera.width,
            "height": camera.height,
            "intrinsics": camera.intrinsics.tolist(),
            "cam_from_frame": camera.cam_from_frame.tolist(),
        }
        cameras.append(record)
    lines = []
    for instance in sample.instances:
        lines.append({"label": instance.label, "points": instance.points.tolist()})
    return {"token": "t", "cameras": cameras, "instances": lines, "timestamp_ns": 5}


def write_shards(
    target: Path, kind: str, count: int, sample: MapSample, meta: AnnotationMeta
) -> None:
    """Write a file's shards, with their manifests: annotations, results or matches of a sample."""
    elements = elements_of_instances(sample.instances)
    results = [(token, vectors_of(elements, meta.classes)) for token in "ab"]
    settings = MetricSettings(meta.classes, grid=BEVGrid(meta.x_range, meta.y_range))
    evaluator = MapEvaluator.from_names(["chamfer", "raster", "pld"], settings)
    for index in range(count):
        shard = Shard(index, count)
        own = replace(sample, token=str(shard.index))
        if kind == ANNOTATIONS:
            write_annotations(target, meta, [own], shard)
        elif kind == RESULTS:
            write_results(shard.path_of(target), results[shard.index :: count])
            shard.write_manifest(target, kind, "", {"model": "m"}, 1)
        else:
            predicted = replace(elements, scores=np.ones(len(elements)))
            matches = [evaluator.match(own.token, predicted, elements)]
            write_matches(target, shard, matches, [], evaluator, settings, "")
