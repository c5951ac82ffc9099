"""Every reader of files with something whole to read, and what of its results can be checked."""

import copy
import json
import pickle
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import torch
import upstream_configs
from argoverse2_road import write_log
from mmdet3d.registry import DATASETS
from mmengine.config import Config
from pyarrow.feather import write_feather

from fuzz import contents, mutations
from fuzz.attacks import CONFIG
from gsmap.apis.checkpoint import adopt_settings, read_weights
from gsmap.checkpoints.settings import MODEL_SETTINGS, plain
from gsmap.converters.argoverse2.samples import Argoverse2Options, read_log
from gsmap.converters.custom import from_records
from gsmap.converters.infos import convert_infos
from gsmap.converters.nuscenes.can_bus import read_messages, signals_at
from gsmap.converters.nuscenes.map import NuScenesLocalMap, open_layers
from gsmap.converters.nuscenes.tables import LIDAR, NuScenesTables
from gsmap.converters.splits import read_split_file
from gsmap.datasets.annotations.file import AnnotationFile, write_annotations
from gsmap.datasets.annotations.record import AnnotationMeta, MapSample
from gsmap.datasets.elements import elements_of_instances
from gsmap.datasets.image_files import read_image
from gsmap.datasets.transforms.points import FEATHER_COLUMNS, read_points
from gsmap.engine.launch import check_config, read_config
from gsmap.evaluation.results_json import RESULTS_KEY, read_samples, vectors_of, write_results
from gsmap.inputs.image_folder import read_image_folder
from gsmap.inputs.info_file import read_info_file
from gsmap.structures.elements import MapElements
from gsmap.utils.faults import in_words
from tools.convert_config import convert

VERSION = "v1.0-trainval"
LIDAR_META = AnnotationMeta("fuzz", "lidar", "train")
EGO_META = AnnotationMeta("fuzz", "ego", "train")


@dataclass
class Reader:
    """One way to read a file.

    Args:
        path: The file that is damaged.
        read: Reads it.
        damages: How its content may be damaged.
        exact: Whether each difference can be noticed, as by a checksum.
    """

    path: Path
    read: Callable[[], Any]
    damages: Sequence[Callable[[bytes, Random], bytes]]
    exact: bool = False

    def __post_init__(self) -> None:
        self.content = self.path.read_bytes()
        self.right = pickle.dumps(self.read())

    def outcome(self, rng: Random) -> tuple[str, str]:
        """Read the file once damaged: what kind of end that took, and the message."""
        mutations.write(self.path, rng.choice(self.damages)(self.content, rng))
        try:
            result = self.read()
        except Exception as error:
            text = in_words(error)
            if text is None:
                return "traceback", f"{type(error).__name__}: {error}"
            names = self.path.name, str(self.path.parent), "sample '", "record "
            named = any(name in text for name in names)
            return ("clear" if named else "vague"), f"{type(error).__name__}: {text}"
        finally:
            mutations.write(self.path, self.content)
        if pickle.dumps(result) == self.right:
            return "right", ""
        wrong = "other content" if self.exact else implausible(result)
        return ("silent", wrong) if wrong else ("other value", "")


def implausible(result: Any) -> str:
    """Say what of a result cannot be, or nothing."""
    if isinstance(result, (list, tuple)):
        return next(filter(None, map(implausible, result)), "")
    if isinstance(result, dict):
        return implausible(list(result.values()))
    if isinstance(result, torch.Tensor):
        return ""  # weights that are not finite are another matter
    if isinstance(result, np.ndarray) and result.dtype.kind == "f":
        return "" if np.isfinite(result).all() else "not finite"
    if isinstance(result, MapElements):
        arrays = result.points, result.scores, result.scales, result.rotations
        return implausible([array for array in arrays if array is not None])
    return _implausible_sample(result) if isinstance(result, MapSample) else ""


def _implausible_sample(sample: MapSample) -> str:
    poses = [sample.global_from_frame]
    poses += [] if sample.ego_from_frame is None else [sample.ego_from_frame]
    poses += [camera.cam_from_frame for camera in sample.cameras]
    paths = [camera.path for camera in sample.cameras]
    for record in [] if sample.lidar is None else [sample.lidar, *sample.lidar.sweeps]:
        poses.append(record.frame_from_lidar)
        paths.append(record.path)
    for pose in poses:
        rotation = pose[:3, :3]
        if not np.isfinite(pose).all() or np.abs(rotation @ rotation.T - np.eye(3)).max() > 0.01:
            return "a pose is no rigid transform"
        if np.linalg.det(rotation) < 0:
            return "a pose mirrors"
    if any(Path(path).is_absolute() or ".." in Path(path).parts for path in paths):
        return "a path leads out of the data root"
    if not all(isinstance(v, str) for v in (sample.token, sample.scene, sample.map_name, *paths)):
        return "a name is no text"
    for instance in sample.instances or []:
        if not 0 <= instance.label < 3 or not np.isfinite(instance.points).all():
            return "an element is out of its domain"
    calibrations = [camera.intrinsics for camera in sample.cameras]
    return "" if all(np.isfinite(k).all() for k in calibrations) else "calibration not finite"


class Files:
    """A folder with a whole file for each reader.

    Args:
        work: Empty folder for the files that are damaged.
        root: A MiniCity in nuScenes' format.
        annotations: One of its annotation files.
    """

    def __init__(self, work: Path, root: Path, annotations: Path) -> None:
        for folder in ("maps", VERSION, "can_bus", "samples"):
            shutil.copytree(root / folder, work / folder)
        self.work = work
        self.sample = AnnotationFile(annotations)[0]
        self.arrow = Path(shutil.copy(annotations, work / "a.arrow"))
        self.log = work / "av2/val/log"
        write_log(self.log, seconds=0.2)

    def readers(self) -> dict[str, Callable[[], Reader]]:
        """Return what makes each reader, by name."""
        tables = ("scene", "sample", "sample_data", "ego_pose", "calibrated_sensor", "sensor",
                  "log")  # fmt: skip
        town = self.work / f"maps/expansion/{self.sample.map_name}.json"
        plan = self.put("splits.json", b'{"train": ["scene-0001", "b"], "val": ["scene-0003"]}')
        byte = mutations.damaged_bytes
        made = {
            "annotation file, its bytes": lambda: self.annotations(byte, exact=True),
            "annotation file, its values": lambda: self.annotations(mutations.damaged_rows),
            "info file of mmdet3d": lambda: self.pickle("v2.pkl", contents.info_v2, read_info_file),
            "info file of MapTRv2": lambda: self.pickle(
                "maptr.pkl", contents.info_of_maptr, self.infos
            ),
            "info file of MapTRv2, Argoverse 2": lambda: self.pickle(
                "av2.pkl", contents.info_of_argoverse2, self.infos
            ),
            "own records": self.records,
            "calibration of own images": self.calibration,
            "results": self.results,
            "config": self.config,
            "config of another repository": self.upstream,
            "image, JPEG": lambda: self.image(".jpg"),
            "image, PNG": lambda: self.image(".png"),
            "nuScenes map expansion": lambda: self.json(town, self.expansion),
            "nuScenes CAN bus": self.can_bus,
            "split file": lambda: self.json(plan, lambda: read_split_file(plan)),
            "Argoverse 2 poses": lambda: self.of_log("*.feather", byte),
            "Argoverse 2 calibration": lambda: self.of_log("calibration/intr*", byte),
            "Argoverse 2 map": lambda: self.of_log(
                "map/log_map*.json", byte, mutations.damaged_json
            ),
            "LiDAR sweep": self.points,
            "LiDAR sweep, Argoverse 2": self.feather,
            "checkpoint": self.weights,
            "settings in a checkpoint": self.settings,
        }
        for name in tables:
            path = self.work / VERSION / f"{name}.json"
            made[f"nuScenes table {name}"] = partial(self.json, path, self.tables)
        return made

    def put(self, name: str, content: bytes) -> Path:
        (self.work / name).write_bytes(content)
        return self.work / name

    def annotations(self, *damages: Any, exact: bool = False) -> Reader:
        def read() -> list[MapSample]:
            file = AnnotationFile(self.arrow)
            file.instance_counts()
            return list(file)

        return Reader(self.arrow, read, damages, exact)

    def pickle(self, name: str, content: Callable[[MapSample], Any], read: Any) -> Reader:
        path = self.put(name, pickle.dumps(content(self.sample)))
        damages = (mutations.damaged_bytes, mutations.damaged_pickle, mutations.damaged_pickle)
        return Reader(path, lambda: read(path), damages)

    def infos(self, path: Path) -> list[MapSample]:
        convert_infos(path, self.work / "infos.arrow", self.work, "train")
        return list(AnnotationFile(self.work / "infos.arrow"))

    def records(self) -> Reader:
        path = self.put("own.pkl", pickle.dumps(contents.own_record(self.sample)))

        def read() -> list[MapSample]:
            records = [pickle.loads(path.read_bytes())]
            from_records(self.work / "own.arrow", records, LIDAR_META, self.work)
            return list(AnnotationFile(self.work / "own.arrow"))

        return Reader(path, read, (mutations.damaged_pickle,))

    def calibration(self) -> Reader:
        content = json.dumps(contents.own_calibration(self.sample)).encode()
        path = self.put("calibration.json", content)

        def read() -> list[MapSample]:
            return self.written(EGO_META, read_image_folder(path, self.work / "frames")[0])

        return self.json(path, read)

    def results(self) -> Reader:
        path = self.work / "results.json"
        elements = elements_of_instances(self.sample.instances)
        write_results(path, [("a", vectors_of(elements, LIDAR_META.classes)), ("b", [])])

        def read() -> dict[str, MapElements]:
            return read_samples(path, RESULTS_KEY, LIDAR_META.classes)[0]

        return self.json(path, read)

    def config(self) -> Reader:
        file = Path(__file__).resolve().parents[2] / "configs/_base_/datasets/minicity.py"
        settings = Config.fromfile(file).to_dict()
        dataset = settings["test_dataloader"]["dataset"]
        dataset |= {"ann_file": str(self.arrow), "data_root": str(self.work), "split": "train"}
        path = self.put("config.json", json.dumps(settings).encode())

        def read() -> list[Any]:
            cfg = read_config(path)
            check_config(cfg)
            dataset = DATASETS.build(cfg.test_dataloader.dataset)
            return [cfg.to_dict(), dataset.metainfo, len(dataset)]

        return self.json(path, read)

    def upstream(self) -> Reader:
        path = self.put("upstream.py", upstream_configs.maptrv2().encode())
        target = self.work / "ours.py"

        def read() -> str:
            convert(path, target)
            Config.fromfile(target, import_custom_modules=False)
            return target.read_text()

        return Reader(path, read, (mutations.damaged_bytes, mutations.damaged_source))

    def image(self, suffix: str) -> Reader:
        content = cv2.imencode(
            suffix, np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
        )[1]
        path = self.put(f"image{suffix}", content.tobytes())
        return Reader(
            path, lambda: read_image(str(path), "camera", (64, 48)), (mutations.damaged_bytes,)
        )

    def tables(self) -> list[MapSample]:
        opened = NuScenesTables(VERSION, self.work, max_sweeps=3)
        drives = [(s, scene) for scene in opened.scene for s in opened.samples_of(scene)]
        found = [opened.read(s, scene) for s, scene in drives if LIDAR in s["data"]]
        return self.written(LIDAR_META, found)

    def written(self, meta: AnnotationMeta, samples: list[MapSample]) -> list[MapSample]:
        """Write samples, as every converter does at its end, and read them."""
        write_annotations(self.work / "written.arrow", meta, samples)
        return list(AnnotationFile(self.work / "written.arrow"))

    def json(self, path: Path, read: Callable[[], Any]) -> Reader:
        damages = (mutations.damaged_bytes, mutations.damaged_json, mutations.damaged_json)
        return Reader(path, read, damages)

    def expansion(self) -> list[np.ndarray]:
        layers = open_layers(self.work, self.sample.map_name, LIDAR_META.classes)
        town = NuScenesLocalMap(layers, LIDAR_META.classes)
        return [i.points for i in town.instances(self.sample.global_from_frame)]

    def can_bus(self) -> Reader:
        path = next((self.work / "can_bus").glob("*_pose.json"))
        scene = path.name.removesuffix("_pose.json")

        def read() -> np.ndarray:
            return signals_at(10**19, np.eye(4), read_messages(self.work, scene))

        return self.json(path, read)

    def of_log(self, name: str, *damages: Any) -> Reader:
        def read() -> list[MapSample]:
            options = Argoverse2Options(self.work / "av2", at="poses:2")
            return self.written(EGO_META, read_log(self.log, options).samples)

        return Reader(next(self.log.glob(name)), read, damages)

    def points(self) -> Reader:
        path = self.put("a.bin", np.ones((9, 5), np.float32).tobytes())
        return Reader(path, lambda: read_points(str(path), 5), (mutations.damaged_bytes,))

    def feather(self) -> Reader:
        path = self.work / "a.feather"
        columns = {name: np.arange(50.0) for name in FEATHER_COLUMNS}
        write_feather(pa.table(columns), str(path), compression="lz4")
        return Reader(path, lambda: read_points(str(path), 5), (mutations.damaged_bytes,))

    def weights(self) -> Reader:
        path = self.work / "weights.pth"
        torch.save({"state_dict": {"a.weight": torch.ones(4, 3)}, "meta": {"epoch": 1}}, path)
        return Reader(path, lambda: read_weights(path), (mutations.damaged_bytes,))

    def settings(self) -> Reader:
        path = self.work / "trained.pth"
        cfg = read_config(CONFIG)
        content = {"state_dict": {"a.weight": torch.ones(4, 3)}}
        meta = {MODEL_SETTINGS: json.dumps(plain(cfg.model.to_dict()))}
        torch.save({**content, "meta": meta}, path)

        def read() -> Any:
            changed = copy.copy(cfg)
            adopt_settings(changed, path, None)
            return plain(changed.model.to_dict())

        return Reader(path, read, (mutations.damaged_settings,))
