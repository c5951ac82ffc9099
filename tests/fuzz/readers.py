"""Every reader of files, with something whole to read."""

import contextlib
import copy
import io
import json
import os
import pickle
import shutil
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

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

from drivemaps.geojson_reading import read_geojson
from drivemaps.lanelet2_reading import read_lanelet2
from fuzz import contents, mutations
from fuzz.attacks import CONFIG
from fuzz.reading import Pictures, Reader
from gsmap.apis.onnx_inferencer import OnnxInferencer
from gsmap.checkpoints.reading import adopt_settings, read_weights
from gsmap.checkpoints.settings import MODEL_SETTINGS, plain
from gsmap.datasets.annotations.file import SHARD_KIND as ANNOTATIONS
from gsmap.datasets.annotations.file import AnnotationFile, write_annotations
from gsmap.datasets.annotations.record import CLASSES, AnnotationMeta, MapSample
from gsmap.datasets.elements import elements_of_instances
from gsmap.datasets.errors import BrokenSampleError
from gsmap.datasets.image_files import read_image
from gsmap.datasets.transforms.points import FEATHER_COLUMNS, read_points
from gsmap.engine.launch import check_config, read_config
from gsmap.evaluation.analysis.change_files import read_changes
from gsmap.evaluation.analysis.changes import change_figures, changed_samples
from gsmap.evaluation.core.match_files import SHARD_KIND as MATCHES
from gsmap.evaluation.core.results_json import RESULTS_KEY, read_samples, vectors_of, write_results
from gsmap.evaluation.core.results_json import SHARD_KIND as RESULTS
from gsmap.prior import GaussianPrior, PriorSettings
from gsmap.structures.elements import MapElements
from gsmap.structures.grid import BEVGrid
from gsmap.utils.shards import Shard, digest
from mapdata.argoverse2.samples import Argoverse2Options, read_log
from mapdata.bags import read_bag
from mapdata.custom import from_records
from mapdata.folders.images import read_image_folder
from mapdata.infos.convert import convert_infos
from mapdata.infos.recordings import read_info_file
from mapdata.nuscenes.can_bus import read_messages, signals_at
from mapdata.nuscenes.convert import NuScenesOptions, convert_nuscenes
from mapdata.nuscenes.map import NuScenesLocalMap, open_layers
from mapdata.nuscenes.tables import LIDAR, NuScenesTables
from mapdata.options import InputOptions
from mapdata.splits import read_split_file
from tools.build_map import main as build_map
from tools.convert_config import convert
from tools.merge import main as merge

VERSION = "v1.0-trainval"
LIDAR_META = AnnotationMeta("fuzz", "lidar", "train")
EGO_META = AnnotationMeta("fuzz", "ego", "train")


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
        changes = self.put("changes.geojson", contents.changes(self.sample.map_name))
        byte, camera = mutations.damaged_bytes, mutations.renamed(self.sample.cameras[0].name)
        made = {
            "annotation file, its bytes": lambda: self.annotations(byte, exact=True),
            "annotation file, its values": lambda: self.annotations(mutations.damaged_rows),
            "annotation file, overwritten in use": lambda: self.in_use(byte),
            "info file of mmdet3d": lambda: self.pickle("v2.pkl", contents.info_v2, read_info_file),
            "info file of MapTR": lambda: self.pickle(
                "maptr.pkl", contents.info_of_maptr, self.infos
            ),
            "info file of Argoverse 2": lambda: self.pickle(
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
            "changes of a map": self.changes,
            "map, GeoJSON": lambda: self.json(changes, lambda: read_geojson(changes, CLASSES)),
            "map, Lanelet2": self.lanelet2,
            "Gaussian prior": self.gaussian_prior,
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

    def recorded(self, read: Callable[[Path], Any]) -> Pictures:
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
        values = yaml.safe_dump(contents.own_calibration(self.sample))
        path = self.put("calibration.yaml", values.encode())
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
        read = partial(
            self.recorded, lambda frames: read_bag(path, InputOptions(frames_dir=frames))
        )
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
        target = self.out / f"whole of {kind}"
        contents.write_shards(target, kind, count, self.sample, LIDAR_META)

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
        losses = upstream_configs.LOSSES.format(pts=5.0, dir=0.005)
        parts = {**upstream_configs.LIFTED, "losses": losses + upstream_configs.SEGMENTATION}
        path = self.put("upstream.py", upstream_configs.maptr(**parts).encode())
        target = self.out / "ours.py"

        def read() -> str:
            convert(path, target)
            Config.fromfile(target, import_custom_modules=False)
            return target.read_text()

        return Reader(path, read, (mutations.damaged_bytes, mutations.damaged_source))

    def image(self, suffix: str) -> Reader:
        pixels = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)
        path = self.put(f"image{suffix}", cv2.imencode(suffix, pixels)[1].tobytes())
        read = partial(read_image, str(path), "camera", (64, 48))
        return Reader(path, read, (mutations.damaged_bytes,))

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

    def lanelet2(self) -> Reader:
        nodes = [
            f"<node id='{k}'><tag k='local_x' v='{k}'/><tag k='local_y' v='{k % 3}'/></node>"
            for k in range(1, 9)
        ]
        ways = []
        for k, kind in ((11, "line_thin"), (13, "pedestrian_marking"), (15, "curbstone")):
            ends = f"<nd ref='{k % 10}'/><nd ref='{k % 10 + 1}'/>"
            ways.append(f"<way id='{k}'>{ends}<tag k='type' v='{kind}'/></way>")
        crosswalk = (
            "<relation id='20'><member type='way' ref='13' role='left'/>"
            "<member type='way' ref='15' role='right'/><tag k='subtype' v='crosswalk'/></relation>"
        )
        content = f"<osm>{''.join(nodes)}{''.join(ways)}{crosswalk}</osm>"
        path = self.put("map.osm", content.encode())
        return Reader(path, lambda: read_lanelet2(path, CLASSES), (mutations.damaged_bytes,))

    def gaussian_prior(self) -> Reader:
        path = self.work / "town.gaussians"
        prior = GaussianPrior(PriorSettings(CLASSES, "town"))
        line = MapElements.from_polylines([[[0.0, -90.0], [3.0, 90.0]]], [0])
        prior.write(np.eye(4), BEVGrid((-15, 15), (-30, 30)), line)
        prior.save(path)

        def read() -> Any:
            return GaussianPrior.load(path).gaussians(0)

        return Reader(path, read, (mutations.damaged_bytes,), exact=True)

    def changes(self) -> Reader:
        path = self.work / "changes.geojson"
        annotations = AnnotationFile(self.arrow)

        def read() -> dict[str, float]:
            found = read_changes(path)
            changed_samples(found, annotations)
            return change_figures(found, found, annotations, found_file=path)

        return self.json(path, read)

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
