"""A trained model on recorded samples: map elements and pictures out."""

import copy
import logging
import tempfile
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, nullcontext
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from mmdet3d.registry import DATASETS
from mmengine.config import Config
from torch.utils.data import DataLoader, Subset

from gsmap.apis.fast_frame import (
    CAPTURE_BY_DEFAULT,
    FastFrames,
    StaticFrame,
    matrix_products,
    reason_against,
)
from gsmap.apis.frame_loader import BrokenFrame, FrameDataset, collate
from gsmap.apis.live_map import LiveMap
from gsmap.apis.loading import load_model
from gsmap.checkpoints.building import building
from gsmap.datasets.annotations.file import AnnotationFile, write_annotations
from gsmap.datasets.annotations.record import CLASSES, AnnotationMeta, MapSample
from gsmap.datasets.elements import elements_of_predictions
from gsmap.datasets.memory import Cameras
from gsmap.datasets.source import Mount, Source, annotated, reframed
from gsmap.evaluation.core.results_json import vectors_of
from gsmap.structures.elements import MapElements
from gsmap.utils.errors import InputError
from gsmap.utils.parallel import result_of, signals_later

if TYPE_CHECKING:  # slow to import, and of no use before there is a model
    from matplotlib.figure import Figure
    from mmdet3d.structures import Det3DDataSample

    from gsmap.datasets.vectorized_map_dataset import VectorizedMapDataset
    from gsmap.visualization.map_visualizer import MapVisualizer

SAMPLES_BY = "tools/infer.py"  # the command that an inferencer's own annotation files name
_GENERATED = "minicity"
_LOGGER = logging.getLogger(__name__)
_LOOK_AT = 100  # samples whose cameras are an input's


def select_samples(
    tokens: Sequence[str], wanted: Sequence[str] | None = None, max_num: int | None = None
) -> list[int]:
    """Choose samples by token, and of these at most a number, spread evenly.

    Args:
        tokens: Tokens of all samples.
        wanted: Tokens of those to choose from; None is all.
        max_num: Largest number of samples; None takes all.

    Returns:
        Indices into ``tokens``, in the order of ``wanted`` if that is given.

    Raises:
        ValueError: If a wanted token is not there, or ``max_num`` is smaller than 1.
    """
    chosen = list(range(len(tokens)))
    if wanted is not None:
        position = {token: index for index, token in enumerate(tokens)}
        unknown = [token for token in wanted if token not in position]
        if unknown:
            raise InputError(f"No sample has the token {unknown[0]!r}; there are {len(tokens)}.")
        chosen = [position[token] for token in wanted]
    return [chosen[i] for i in spread_evenly(len(chosen), max_num)]


def spread_evenly(count: int, max_num: int | None = None) -> list[int]:
    """Return at most ``max_num`` indices below ``count``; ValueError if that is less than 1."""
    if max_num is None or max_num >= count:
        return list(range(count))
    if max_num < 1:
        raise InputError(f"max_num must be >= 1, got {max_num}.")
    return np.linspace(0, count - 1, max_num).round().astype(int).tolist()


def _build_visualizer(cfg: Config) -> "MapVisualizer":
    """Build a visualizer with the config's options and without its backends."""
    from gsmap.visualization.map_visualizer import MapVisualizer

    options = dict(cfg.get("visualizer") or {})
    if str(options.pop("type", "MapVisualizer")).split(".")[-1] != "MapVisualizer":
        options = {}
    own = {k: v for k, v in options.items() if k not in ("name", "vis_backends", "save_dir")}
    with building(cfg, MapVisualizer):
        return MapVisualizer(name=f"inferencer-{id(cfg)}", **own)


class MapInferencer:
    """Runs a trained model on samples, through the pipeline that the config tests with.

    Args:
        config: Config file of the model, a ``Config``, or the name of a model
            (``checkpoints/named_models.py``), such as ``gsmap_r18_minicity``.
        checkpoint: Its checkpoint, or such a name. None means the named model's, and without a name
            the initial weights (for trying out a pipeline).
        device: Where to run, or several devices that share the batches; a GPU if there is one.
        cfg_options: Overrides of the config, by dotted name.
        amp: Whether to run in mixed precision: on a GPU backbone and neck in float16 and other
            matrix products in TF32, on a CPU all in bfloat16.
        cuda_graphs: Whether frames on a GPU are recorded once for each size of images and then
            replayed (`FastFrames`). None: as ``CAPTURE_BY_DEFAULT`` says, if the model has a static
            form.

    Raises:
        FileNotFoundError: If the config or the checkpoint does not exist.
        ValueError: If the checkpoint belongs to another architecture, or cannot be read; if
            ``cuda_graphs`` is True on another device, or for a model without a static form.
    """

    def __init__(
        self,
        config: str | Path | Config,
        checkpoint: str | Path | None = None,
        device: str | torch.device | Sequence[str | torch.device] | None = None,
        cfg_options: dict | None = None,
        amp: bool = False,
        cuda_graphs: bool | None = None,
    ):
        self.model = load_model(config, checkpoint, cfg_options=cfg_options)
        self.cfg: Config = self.model.cfg
        self._generated = self.model.training_dataset == _GENERATED
        device = device or ("cuda" if torch.cuda.is_available() else "cpu")
        names = [device] if isinstance(device, str | torch.device) else list(device)
        self.devices = [torch.device(name) for name in names]
        models = [self.model, *(copy.deepcopy(self.model) for _ in names[1:])]
        self.replicas = [m.to(d) for m, d in zip(models, self.devices, strict=True)]
        self.amp = amp
        self._fast_frames = [
            self._open_fast_frames(model, device, cuda_graphs)
            for model, device in zip(self.replicas, self.devices, strict=True)
        ]
        self._camera_embeds = getattr(self.model.bev_encoder, "cams_embeds", None)
        self.visualizer = _build_visualizer(self.cfg)
        self._scratch = tempfile.TemporaryDirectory(prefix="gsmap-")
        self._files = 0

    def _open_fast_frames(
        self, model: Any, device: torch.device, cuda_graphs: bool | None
    ) -> FastFrames | None:
        """Replayer of frames on a GPU, or None if ``test_step`` runs them."""
        if device.type != "cuda":
            if cuda_graphs:
                raise InputError(f"cuda_graphs=True needs a GPU, got {device}: leave it out.")
            return None
        if self.amp and model.img_backbone is not None:
            model.halve_backbone()
        reason = reason_against(model)
        if cuda_graphs and reason:
            raise InputError(f"cuda_graphs=True does not serve this model: {reason}. Leave it out.")
        if reason or not (CAPTURE_BY_DEFAULT if cuda_graphs is None else cuda_graphs):
            return None
        return FastFrames(StaticFrame(model), device)

    def dataset(
        self,
        source: str | Path | Source | Sequence[MapSample],
        data_root: str | Path | None = None,
    ) -> "VectorizedMapDataset":
        """Open samples as the config's test data set, with its pipeline.

        Samples of another annotation frame are seen from the config's. If none of their cameras is
        one of the config's, all of theirs take part, however many.

        Args:
            source: An annotation file, what ``mapdata.inputs.open_input`` makes of any other
                recording, or samples in the frame of the config.
            data_root: Folder that image paths start from; by default that of the file, or the
                config's where an annotation file lies apart from its images.

        Raises:
            FileNotFoundError: If a file does not exist.
            ValueError: If a file cannot be used with this config; the message says why.
        """
        self._files += 1
        root = None if data_root is None else Path(data_root)
        if isinstance(source, str | Path):
            source = annotated(source, root)
        self._say_generated(source)
        if not isinstance(source, Source):
            mount = self.model.mount
            source = Source(source, mount.frame, root, ground_z_m=mount.ground_z_m)
        settings: dict[str, Any] = dict(self.cfg.test_dataloader.dataset)
        samples, mount = source.samples, self.model.mount
        if not settings.get("frame"):
            mount = Mount(source.frame, source.ground_z_m)
        if isinstance(samples, AnnotationFile) and mount.suits(source.frame, source.ground_z_m):
            path = samples.path
        else:
            samples = [reframed(s, source.frame, mount, source.ground_z_m) for s in samples]
            path = self._annotation_file(samples, mount, source.has_poses)
            settings["ground_z_m"] = None
        settings |= {"ann_file": str(path.resolve()), "test_mode": True, "split": None, "dim": None}
        settings["cameras"] = self._cameras(samples)
        settings["serialize_data"] = len(samples) > 1  # costs a collection of all garbage
        if source.data_root is not None:
            settings["data_root"] = str(source.data_root.resolve())
        with building(self.cfg):
            dataset = DATASETS.build(settings)
        self.visualizer.dataset_meta = dataset.metainfo
        return dataset

    def _say_generated(self, source: Any) -> None:
        """Warn once, on other images, that the model was trained on generated streets alone."""
        if not self._generated or not isinstance(source, Source):
            return
        samples = source.samples
        if isinstance(samples, AnnotationFile) and samples.meta.dataset == _GENERATED:
            return
        self._generated = False
        _LOGGER.warning(
            "the model has seen generated streets alone (MiniCity): on real images its maps are a "
            "trial, not a result; train it on your own (docs/custom_data.md)."
        )

    def _cameras(self, samples: Sequence[MapSample]) -> Sequence[str] | None:
        """Return the config's cameras, or all of the samples' if they have none of these."""
        trained = self.cfg.test_dataloader.dataset.get("cameras")
        found = dict.fromkeys(c.name for s in islice(samples, _LOOK_AT) for c in s.cameras)
        if trained is None or not found or set(found) & set(trained):
            return trained
        return list(found)

    def _fit_cameras(
        self, dataset: "VectorizedMapDataset", allow_missing_cameras: bool
    ) -> "VectorizedMapDataset":
        """Leave out cameras that no sample has, and fit the model's cameras to the others.

        Each gets its own embedding, or that of the model's camera that looks most like it.
        """
        trained = self.cfg.test_dataloader.dataset.get("cameras")
        names = dataset.cameras
        if trained is None or names is None:
            return dataset
        if allow_missing_cameras:
            seen = {c.name for i in range(len(dataset)) for c in dataset.sample(i).cameras}
            dataset = copy.copy(dataset)
            dataset.cameras = names = tuple(name for name in names if name in seen) or names
        if self._camera_embeds is None:
            return dataset
        from gsmap.apis.rig_fit import camera_rows

        rows = camera_rows(dataset, trained)
        for replica, device in zip(self.replicas, self.devices, strict=True):
            embeds = self._camera_embeds.detach()[rows].to(device)
            replica.bev_encoder.cams_embeds = torch.nn.Parameter(embeds)
        return dataset

    def _annotation_file(self, samples: Sequence[MapSample], mount: Mount, has_poses: bool) -> Path:
        """Write samples to an annotation file that lives as long as the inferencer."""
        options = self.cfg.test_dataloader.dataset
        grid = options.get("grid") or self.cfg.model.grid
        meta = AnnotationMeta(
            dataset="samples",
            frame=mount.frame,
            split="test",
            classes=tuple(options.get("classes") or CLASSES),
            x_range=tuple(grid["x_range"]),
            y_range=tuple(grid["y_range"]),
            dim=max((i.points.shape[1] for s in samples for i in s.instances or ()), default=2),
            options={} if has_poses else {"poses": False},
            command=SAMPLES_BY,
            ground_z_m=mount.ground_z_m,
        )
        path = Path(self._scratch.name) / f"samples{self._files}.arrow"
        write_annotations(path, meta, samples)
        return path

    @staticmethod
    def lidar_points(dataset: "VectorizedMapDataset", index: int) -> np.ndarray | None:
        """Return a sample's LiDAR points (x, y, z), if it has a sweep. (n, 3)

        They are in the annotation frame, in metres.

        Raises:
            FileNotFoundError: If the sweep's file does not exist.
            ValueError: If it is neither nuScenes' (five float32 values a point) nor Argoverse 2's.
        """
        lidar = dataset.sample(index).lidar
        if lidar is None:
            return None
        path = Path(dataset.data_root, lidar.path)
        if not path.is_file():
            raise FileNotFoundError(f"There is no LiDAR sweep {path}.")
        from gsmap.datasets.transforms.points import read_points

        matrix = lidar.frame_from_lidar
        return read_points(str(path), 5)[:, :3] @ matrix[:3, :3].T + matrix[:3, 3]

    def predict(
        self,
        dataset: "VectorizedMapDataset",
        indices: Sequence[int] | None = None,
        batch_size: int = 1,
        num_workers: int = 0,
        allow_missing_cameras: bool = False,
        on_broken: Callable[[BrokenFrame], object] | None = None,
        stream: Any = None,
    ) -> "Iterator[Det3DDataSample]":
        """Run the model; several devices take turns.

        Args:
            dataset: From ``dataset()``.
            indices: Which samples; all by default.
            batch_size: Samples per forward pass.
            num_workers: Processes that read images.
            allow_missing_cameras: Whether cameras that a sample lacks are left blank; those that no
                sample has are left out.
            on_broken: Called with each sample that cannot be used, which is then left out; None
                lets it be an error.
            stream: With a model that remembers, the drive that the samples continue, over several
                calls (`new_stream`); None starts a new one for each scene. It is never ahead of
                what was yielded by more than a batch.

        Yields:
            The samples in order, with ``pred_instances_3d`` on the CPU.

        Raises:
            ValueError: If a file of a sample is missing or damaged, or a camera is absent; with
                memory, if frames are out of order, and if there are several devices.
        """
        ahead = 0 if stream is not None else len(self.replicas)  # batches before they are asked for
        if stream is None and self.model.temporal is not None:
            stream = self._memory().new_scenes()
        elif stream is not None:
            self._memory()
        dataset = self._fit_cameras(dataset, allow_missing_cameras)
        frames = FrameDataset(dataset, allow_missing_cameras)
        chosen = frames if indices is None else Subset(frames, indices)
        batches = DataLoader(chosen, batch_size, num_workers=num_workers, collate_fn=collate)
        with ExitStack() as stack:
            pools = [stack.enter_context(ThreadPoolExecutor(1)) for _ in self.replicas]
            pending: deque[Future] = deque()
            for number, (batch, broken) in enumerate(batches):
                for frame in broken:
                    if on_broken is None:
                        raise InputError(frame.reason)
                    on_broken(frame)
                if batch is not None:
                    turn = number % len(pools)
                    with signals_later():  # a pool has locks, see `result_of`
                        pending.append(pools[turn].submit(self._step, turn, batch, stream))
                if len(pending) > ahead:
                    yield from result_of(pending.popleft())
            while pending:
                yield from result_of(pending.popleft())

    def new_stream(self) -> Any:
        """Return the empty memory of a drive, for `predict`: its frames must come in order.

        A frame that comes twice, too late or is of another scene is an error that names both
        frames. ValueError if the model has no memory.
        """
        return self._memory().new_stream()

    def _memory(self) -> Any:
        """Return the model's memory; ValueError if it has none, or there are several devices."""
        if self.model.temporal is None:
            raise InputError("the model has no memory (temporal): leave the stream out.")
        if len(self.devices) > 1:
            raise InputError("a model with memory runs on one device: name a single one.")
        return self.model.temporal

    @torch.no_grad()
    def _step(
        self, turn: int, batch: dict[str, Any], stream: Any = None
    ) -> "list[Det3DDataSample]":
        """Predict a batch on one device."""
        model, device = self.replicas[turn], self.devices[turn]
        fast_frames = self._fast_frames[turn]
        if fast_frames is not None and fast_frames.serves(batch):
            return fast_frames(batch)
        memory = nullcontext() if stream is None else self.model.temporal.using(stream)
        on_cpu = device.type == "cpu"
        with (
            memory,
            matrix_products(model.half_backbone is not None),
            torch.autocast(device.type, enabled=self.amp and on_cpu),
        ):
            return [sample.cpu() for sample in model.test_step(batch)]

    def predict_images(
        self,
        images: Cameras,
        intrinsics: Cameras,
        cam_from_frame: Cameras,
        frame: str | None = None,
        allow_missing_cameras: bool = False,
        can_bus: np.ndarray | None = None,
    ) -> "Det3DDataSample":
        """Run the model on one frame in memory; ``live`` is faster for many frames.

        Errors are those of `LiveMap`.

        Args:
            images: Image of each camera, (H, W, 3) in uint8, by name. An unnamed camera in a list,
                or one of another name, stands for the camera of the model that it resembles most.
            intrinsics: Intrinsic matrix of each camera, in pixels. (3, 3)
            cam_from_frame: Pose of the frame in each camera, in metres. (4, 4)
            frame: Frame of the poses, as `LiveMap` takes it.
            allow_missing_cameras: Whether cameras of the model may be absent.
            can_bus: Signals of the vehicle (18,), or None.

        Returns:
            The prediction.
        """
        live = self.live(intrinsics, cam_from_frame, frame, allow_missing_cameras)
        return live.predict(images, can_bus)

    def live(
        self,
        intrinsics: Cameras,
        cam_from_frame: Cameras,
        frame: str | None = None,
        allow_missing_cameras: bool = False,
    ) -> LiveMap:
        """Function from the images of each frame to its map.

        Args:
            intrinsics: Intrinsic matrix of each camera, in pixels. (3, 3)
            cam_from_frame: Pose of the frame in each camera, in metres. (4, 4)
            frame: Frame of the poses, as `LiveMap` takes it.
            allow_missing_cameras: Whether cameras of the model may be absent.
        """
        return LiveMap(self, intrinsics, cam_from_frame, frame, allow_missing_cameras)

    def elements(self, data_sample: "Det3DDataSample") -> MapElements:
        """Return a predicted sample's map: polylines in metres, labels, scores, Gaussians."""
        return elements_of_predictions(data_sample.pred_instances_3d)

    def vectors(self, data_sample: "Det3DDataSample") -> list[dict[str, Any]]:
        """Return a predicted sample's ``vectors`` of the results JSON."""
        return vectors_of(self.elements(data_sample), self.visualizer.dataset_meta["classes"])

    def draw(self, data_sample: "Det3DDataSample", **options: Any) -> "Figure":
        """Compose a predicted sample's picture; options as in ``MapVisualizer.draw_sample``."""
        return self.visualizer.draw_sample(data_sample, **options)

    def __call__(
        self,
        source: str | Path | Source | Sequence[MapSample],
        data_root: str | Path | None = None,
        stream: Any = None,
    ) -> "list[Det3DDataSample]":
        """Predict all samples of a source; arguments as in ``dataset`` and ``predict``."""
        return list(self.predict(self.dataset(source, data_root), stream=stream))
