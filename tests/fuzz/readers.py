"""Every reader of files with something whole to read, and what of its results can be checked."""

import contextlib
import copy
import errno
import io
import json
import os
import pickle
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from random import Random
from typing import Any, ClassVar

import cv2
import numpy as np
import pyarrow as pa
import torch
import upstream_configs
import yaml
from argoverse2_road import write_log
from bag_cases import Recorder
from bag_cases import record as record_bag
from mmdet3d.registry import DATASETS
from mmengine.config import Config
from pyarrow.feather import write_feather

from fuzz import contents, mutations
from fuzz.attacks import CONFIG
from gsmap.apis.onnx_inferencer import OnnxInferencer
from gsmap.checkpoints.reading import adopt_settings, read_weights
from gsmap.checkpoints.settings import MODEL_SETTINGS, plain
from gsmap.datasets.annotations.file import SHARD_KIND as ANNOTATIONS
from gsmap.datasets.annotations.file import AnnotationFile, write_annotations
from gsmap.datasets.annotations.record import AnnotationMeta, MapSample
from gsmap.datasets.elements import elements_of_instances
from gsmap.datasets.errors import BrokenSampleError
from gsmap.datasets.image_files import read_image
from gsmap.datasets.transforms.points import FEATHER_COLUMNS, read_points
from gsmap.engine.launch import check_config, read_config
from gsmap.evaluation.chamfer_ap import ChamferConfig
from gsmap.evaluation.evaluator import MapEvaluator
from gsmap.evaluation.match_files import SHARD_KIND as MATCHES
from gsmap.evaluation.match_files import write_matches
from gsmap.evaluation.raster_ap import RasterConfig
from gsmap.evaluation.results_json import RESULTS_KEY, read_samples, vectors_of, write_results
from gsmap.evaluation.results_json import SHARD_KIND as RESULTS
from gsmap.structures.elements import MapElements
from gsmap.utils.faults import in_words
from gsmap.utils.shards import Shard, digest
from mapdata.argoverse2.samples import Argoverse2Options, read_log
from mapdata.bags import read_bag
from mapdata.custom import from_records
from mapdata.folders.images import read_image_folder
from mapdata.folders.rig import Recording
from mapdata.infos.convert import convert_infos
from mapdata.infos.recordings import read_info_file
from mapdata.nuscenes.can_bus import read_messages, signals_at
from mapdata.nuscenes.convert import NuScenesOptions, convert_nuscenes
from mapdata.nuscenes.map import NuScenesLocalMap, open_layers
from mapdata.nuscenes.tables import LIDAR, NuScenesTables
from mapdata.splits import read_split_file
from tools.build_map import main as build_map
from tools.convert_config import convert
from tools.merge import main as merge

VERSION = "v1.0-trainval"
LIDAR_META = AnnotationMeta("fuzz", "lidar", "train")
EGO_META = AnnotationMeta("fuzz", "ego", "train")
_RUNS = ("os.system", "os.exec", "os.posix_spawn", "os.fork", "subprocess.Popen", "pty.spawn")
_CHANGES = {"os.rename": 2, "os.mkdir": 1, "os.remove": 1, "os.rmdir": 1, "os.symlink": 2}
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT


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
    out: ClassVar[Path]
    """The only folder that a read may write to."""

    def __post_init__(self) -> None:
        self.content = self.path.read_bytes()
        self.right = pickle.dumps(self.read())
        self._reading = False
        self._deeds: list[tuple[str, str]] = []

    def watch(self, event: str, arguments: tuple[Any, ...]) -> None:
        """Refuse and note what a read has no business to do: run a program, or write elsewhere."""
        if not self._reading:
            return
        deed = ("code", str(arguments)) if event in _RUNS else None
        writes = event in _CHANGES or (event == "open" and arguments[2] & _WRITING)
        allowed = os.path.realpath(self.out), f"{tempfile.gettempdir()}/tmp", "/dev/"
        for path in arguments[: _CHANGES.get(event, 1)] if writes else ():
            if isinstance(path, int) or (event != "open" and arguments[-1] >= 0):
                continue  # a file or a folder that is open already
            place = os.path.realpath(os.fsdecode(path))
            if not place.startswith(allowed) and "__pycache__" not in place:
                deed = "outside", place
        if deed is not None:
            self._deeds.append((deed[0], f"{event} {deed[1]}"))
            raise PermissionError(errno.EPERM, *self._deeds[-1])

    def outcome(self, rng: Random) -> tuple[str, str]:
        """Read the file once damaged: what kind of end that took, and the message."""
        mutations.write(self.path, rng.choice(self.damages)(self.content, rng))
        self._deeds.clear()
        end = self._read_damaged()
        return self._deeds[0] if self._deeds else end

    def _read_damaged(self) -> tuple[str, str]:
        self._reading = True
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
            self._reading = False
            mutations.write(self.path, self.content)
        if pickle.dumps(result) == self.right:
            return "right", ""
        wrong = "other content" if self.exact else implausible(result)
        return ("silent", wrong) if wrong else ("other value", "")


@dataclass
class Pictures:
    """A recording's samples, and what is wrong with the images that were made of it."""

    samples: list[MapSample]
    wrong: str


def implausible(result: Any) -> str:
    """Say what of a result cannot be, or nothing."""
    if isinstance(result, Pictures):
        return result.wrong or implausible(result.samples)
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
        Reader.out = self.out = work / "out"
        self.out.mkdir()
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
        byte, camera = mutations.damaged_bytes, mutations.renamed(self.sample.cameras[0].name)
        made = {
            "annotation file, its bytes": lambda: self.annotations(byte, exact=True),
            "annotation file, its values": lambda: self.annotations(mutations.damaged_rows),
            "annotation file, overwritten in use": lambda: self.in_use(byte),
            "info file of mmdet3d": lambda: self.pickle("v2.pkl", contents.info_v2, read_info_file),
            "info file of MapTRv2": lambda: self.pickle(
                "maptr.pkl", contents.info_of_maptr, self.infos
            ),
            "info file of MapTRv2, Argoverse 2": lambda: self.pickle(
                "av2.pkl", contents.info_of_argoverse2, self.infos
            ),
            "own records": self.records,
            "calibration of own images": lambda: self.calibration(
                "json", byte, mutations.damaged_json, mutations.damaged_json
            ),
            "calibration of own images, YAML": lambda: self.calibration(
                "yaml", byte, mutations.damaged_yaml, mutations.damaged_yaml, camera
            ),
            "poses of own images": lambda: self.calibration("yaml", byte, poses=True),
            "images of own cameras": self.image_of_folder,
            "bag of ROS 1": lambda: self.bag("ros1"),
            "bag of ROS 2, sqlite3": lambda: self.bag("sqlite"),
            "bag of ROS 2, MCAP": lambda: self.bag("mcap"),
            "bag of ROS 2, its metadata": lambda: self.bag("sqlite_yaml"),
            "name of a scene": self.scene_name,
            "name of a split": self.split_name,
            "results": self.results,
            "manifest of annotations": lambda: self.shards(ANNOTATIONS, 2),
            "manifest of results": lambda: self.shards(RESULTS, 2),
            "manifest of matches": lambda: self.shards(MATCHES, 1),
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
        if find_spec("onnx") and find_spec("onnxruntime"):
            made["exported model"] = self.exported
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

    def in_use(self, *damages: Any) -> Reader:
        used, whole = self.out / "used.arrow", self.arrow.read_bytes()
        path = self.put("other.arrow", whole)

        def read() -> list[MapSample]:
            used.write_bytes(whole)
            file = AnnotationFile(used)
            used.write_bytes(path.read_bytes())
            os.utime(used, ns=(1, 1))  # a clock of coarse ticks may give the time that it had
            return list(file)

        return Reader(path, read, damages, exact=True)

    def pickle(self, name: str, content: Callable[[MapSample], Any], read: Any) -> Reader:
        path = self.put(name, pickle.dumps(content(self.sample)))
        damages = (mutations.damaged_bytes, mutations.damaged_pickle, mutations.damaged_pickle)
        return Reader(path, lambda: read(path), damages)

    def infos(self, path: Path) -> list[MapSample]:
        convert_infos(path, self.out / "infos.arrow", self.work, "train")
        return list(AnnotationFile(self.out / "infos.arrow"))

    def records(self) -> Reader:
        path = self.put("own.pkl", pickle.dumps(contents.own_record(self.sample)))

        def read() -> list[MapSample]:
            records = [pickle.loads(path.read_bytes())]
            from_records(self.out / "own.arrow", records, LIDAR_META, self.work)
            return list(AnnotationFile(self.out / "own.arrow"))

        return Reader(path, read, (mutations.damaged_pickle,))

    def recorded(self, read: Callable[[Path], Recording]) -> Pictures:
        """Read a recording and look at the images that it makes."""
        frames = self.out / "frames"
        shutil.rmtree(frames, ignore_errors=True)
        found = read(frames)
        samples, wrong = self.written(EGO_META, found.samples), []
        made = [path.relative_to(frames) for path in frames.rglob("*") if path.is_file()]
        wrong += [f"made {path}" for path in made if len(path.parts) != 3]
        for camera in (camera for sample in samples for camera in sample.cameras):
            try:
                path = str(found.data_root / camera.path)
                image = read_image(path, "", (camera.width, camera.height))
                wrong += [] if image.any() else [f"{camera.path} is black"]
            except BrokenSampleError as error:
                wrong += [] if found.notes else [str(error)]
        return Pictures(samples, "; ".join(wrong))

    def calibration(self, suffix: str, *damages: Any, poses: bool = False) -> Reader:
        values = contents.own_calibration(self.sample)
        if poses:
            times = self.put("poses.csv", contents.own_poses(self.sample))
            values["poses"] = times.name
        dump = json.dumps if suffix == "json" else partial(yaml.safe_dump, sort_keys=False)
        path = self.put(f"calibration.{suffix}", dump(values).encode())
        read = partial(self.recorded, partial(read_image_folder, path))
        return Reader(times if poses else path, read, damages)

    def image_of_folder(self) -> Reader:
        path = self.put(
            "calibration.yaml", yaml.safe_dump(contents.own_calibration(self.sample)).encode()
        )
        read = partial(self.recorded, partial(read_image_folder, path))
        image = self.work / self.sample.cameras[0].path
        return Reader(image, read, (mutations.damaged_bytes,))

    def bag(self, kind: str) -> Reader:
        """Return the reader of a bag of one sample, its raw and its compressed images in turn."""
        recorder = Recorder(self.work / f"bag_{kind}", kind.removesuffix("_yaml"))
        record_bag(recorder, [self.sample], self.work, raw="rgb8" if kind == "sqlite" else None,
               distortion=(-0.2, 0.05, 0.0, 0.0, 0.0))  # fmt: skip
        path = recorder.path
        pattern = {"sqlite": "*.db3", "mcap": "*.mcap"}.get(kind)
        path = next(path.glob(pattern)) if pattern else path
        read = partial(self.recorded, lambda frames: read_bag(path, frames))
        damaged = path / "metadata.yaml" if path.is_dir() else path
        texts = (mutations.damaged_yaml,) if path.is_dir() else ()
        names = mutations.renamed(self.sample.cameras[0].name)
        return Reader(damaged, read, (mutations.damaged_bytes, names, *texts))

    def scene_name(self) -> Reader:
        """Return the reader of an annotation file, which makes maps named by its scenes."""
        path = Path(shutil.copy(self.arrow, self.work / "scenes.arrow"))
        results = self.work / "maps.json"
        write_results(results, [(s.token, []) for s in AnnotationFile(path)])

        def read() -> list[str]:
            maps = self.out / "maps"
            shutil.rmtree(maps, ignore_errors=True)
            build_map([str(results), "--ann", str(path), "--out", str(maps)])
            return sorted(p.name for p in maps.iterdir())

        return Reader(path, read, (mutations.damaged_column("scene"),))

    def split_name(self) -> Reader:
        scenes = json.loads((self.work / VERSION / "scene.json").read_bytes())
        splits = {"train": [scenes[0]["name"]], "val": [scene["name"] for scene in scenes[1:]]}
        path = self.put("own_splits.json", json.dumps(splits).encode())
        options = NuScenesOptions(
            self.work, VERSION, dataset="minicity", split_file=path, out_dir=self.out / "splits"
        )

        def read() -> list[str]:
            shutil.rmtree(self.out / "splits", ignore_errors=True)
            convert_nuscenes(options)
            return sorted(path.name for path in (self.out / "splits").iterdir())

        return Reader(path, read, (mutations.renamed("train"), mutations.renamed("val")))

    def results(self) -> Reader:
        path = self.work / "results.json"
        elements = elements_of_instances(self.sample.instances)
        write_results(path, [("a", vectors_of(elements, LIDAR_META.classes)), ("b", [])])

        def read() -> dict[str, MapElements]:
            return read_samples(path, RESULTS_KEY, LIDAR_META.classes)[0]

        return self.json(path, read)

    def shards(self, kind: str, count: int) -> Reader:
        elements = elements_of_instances(self.sample.instances)
        results = [(token, vectors_of(elements, LIDAR_META.classes)) for token in "ab"]
        evaluator = MapEvaluator(
            ChamferConfig(LIDAR_META.classes), RasterConfig(LIDAR_META.classes)
        )
        target = self.out / f"whole of {kind}"
        for shard in (Shard(index, count) for index in range(count)):
            sample = replace(self.sample, token=str(shard.index))
            if kind == ANNOTATIONS:
                write_annotations(target, LIDAR_META, [sample], shard)
            elif kind == RESULTS:
                write_results(shard.path_of(target), results[shard.index :: count])
                shard.seal(target, kind, "", {"model": "m"}, 1)
            else:
                matches = [evaluator.match(sample.token, elements, elements)]
                write_matches(target, shard, matches, [], evaluator, "")

        def read() -> str:
            with contextlib.redirect_stdout(io.StringIO()):
                merge([str(target)])
            return digest(target)

        path = Shard(0, count).path_of(target)
        return self.json(path.with_name(f"{path.name}.manifest"), read)

    def exported(self) -> Reader:
        path = self.put("model.onnx", contents.exported_model())
        images = np.random.default_rng(0).integers(0, 255, (2, 4, 6, 3), np.uint8)

        def read() -> MapElements:
            meta = {"lidar2img": np.stack([np.eye(4)] * 2), "can_bus": np.zeros(18)}
            return OnnxInferencer(path)(images, meta)

        return Reader(path, read, (mutations.damaged_bytes, mutations.damaged_metadata))

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
        target = self.out / "ours.py"

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
        write_annotations(self.out / "written.arrow", meta, samples)
        return list(AnnotationFile(self.out / "written.arrow"))

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
