"""Inference with a trained model on recorded samples, which returns map elements and figures."""

import copy
import logging
import tempfile
import threading
import uuid
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
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
from gsmap.apis.input_dataset import open_dataset
from gsmap.apis.live_map import LiveMap
from gsmap.apis.loading import load_model
from gsmap.apis.map_priors import maps_for
from gsmap.checkpoints.building import building
from gsmap.checkpoints.settings import single_dataset_of
from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import MapSample
from gsmap.datasets.elements import elements_of_predictions
from gsmap.datasets.memory import Cameras
from gsmap.datasets.source import Source, open_annotations
from gsmap.evaluation.core.results_json import vectors_of
from gsmap.structures.elements import MapElements
from gsmap.utils.errors import InputError
from gsmap.utils.parallel import delay_signals, result_of

if TYPE_CHECKING:  # slow to import
    from matplotlib.figure import Figure
    from mmdet3d.structures import Det3DDataSample

    from gsmap.datasets.vectorized_map_dataset import VectorizedMapDataset
    from gsmap.prior.opening import AnyPrior
    from gsmap.visualization.map_visualizer import MapVisualizer

_GENERATED = "minicity"  # data set of generated images
_LOGGER = logging.getLogger(__name__)


def select_samples(
    tokens: Sequence[str], wanted: Sequence[str] | None = None, max_num: int | None = None
) -> list[int]:
    """Select samples by token, then at most ``max_num`` evenly spaced samples of these.

    Args:
        tokens: Tokens of all samples.
        wanted: Tokens to select from, a repeated one once; None selects from all.
        max_num: Largest number of samples, at least 1; None selects all.

    Returns:
        Indices into ``tokens``, in the order of ``wanted`` if it is given.

    Raises:
        ValueError: If ``tokens`` lacks a wanted token, or ``max_num`` is smaller than 1.
    """
    indices = list(range(len(tokens)))
    if wanted is not None:
        index_by_token = {token: index for index, token in enumerate(tokens)}
        indices = []
        for token in dict.fromkeys(wanted):  # in the given order, each once
            if token not in index_by_token:
                raise InputError(
                    f"No sample has the token {token!r}; there are {len(tokens)} samples."
                )
            indices.append(index_by_token[token])
    return [indices[i] for i in spread_evenly(len(indices), max_num=max_num)]


def spread_evenly(count: int, max_num: int | None = None) -> list[int]:
    """Return evenly spaced indices.

    Args:
        count: Upper bound of the indices, exclusive.
        max_num: Largest number of indices, at least 1; None returns all.

    Raises:
        ValueError: If ``max_num`` is smaller than 1.
    """
    if max_num is None or max_num >= count:
        return list(range(count))
    if max_num < 1:
        raise InputError(f"max_num must be >= 1, got {max_num}.")
    return np.linspace(0, count - 1, num=max_num).round().astype(int).tolist()


def _build_visualizer(cfg: Config) -> "MapVisualizer":
    """Build a visualizer without backends from the options of a config."""
    from gsmap.visualization.map_visualizer import MapVisualizer

    options = dict(cfg.get("visualizer") or {})
    kind = str(options.pop("type", "MapVisualizer"))
    if kind.split(".")[-1] != "MapVisualizer":  # the options are for another class
        options = {}
    # The inferencer returns figures. It needs no backends that store them in a folder.
    for name in ("name", "vis_backends", "save_dir"):
        options.pop(name, None)
    with building(cfg, kind=MapVisualizer):  # errors name the config and the part
        return MapVisualizer(name=f"inferencer-{id(cfg)}", **options)


class MapInferencer:
    """Predictor of map elements from samples, with the test pipeline of a config.

    Args:
        config: Config file of the model, a ``Config``, or the name of a model
            (``checkpoints/named_models.py``), for example ``gsmap_r18_minicity``.
        checkpoint: File of the weights, or name of a model. None selects the weights of the model
            that ``config`` names, or initial weights (to try out a pipeline) if it names no model.
        device: Device of the model, or several devices that share the batches. By default a GPU if
            one is available.
        cfg_options: Overrides of the config, by dotted name.
        amp: Whether to use mixed precision. On a GPU, backbone and neck run in float16 and other
            matrix products in TF32. On a CPU, all run in bfloat16.
        cuda_graphs: Whether frames on a GPU are recorded once for each image size and replayed
            (`FastFrames`). This needs a model with a static form: a prediction of fixed operations
            on tensors of fixed sizes (`StaticFrame`). None uses ``CAPTURE_BY_DEFAULT`` for such
            models, and does not record others.

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
        self.model = load_model(config, checkpoint=checkpoint, cfg_options=cfg_options)
        self.cfg: Config = self.model.cfg
        single_dataset_of(self.cfg, part="test", purpose="inference")
        # True until the user has been warned about a model that was trained on generated images.
        self._warn_generated = self.model.training_dataset == _GENERATED
        self.amp = amp
        device = device or ("cuda" if torch.cuda.is_available() else "cpu")
        given_devices = [device] if isinstance(device, str | torch.device) else list(device)
        self.devices = [torch.device(name) for name in given_devices]
        # The first device takes the model itself, and each further device takes a copy.
        copies = [copy.deepcopy(self.model) for _ in self.devices[1:]]
        self.replicas: list[Any] = []
        self._fast_frames: list[FastFrames | None] = []
        for model, target in zip([self.model, *copies], self.devices, strict=True):
            replica = model.to(target)
            self.replicas.append(replica)
            fast_frames = self._build_fast_frames(replica, device=target, cuda_graphs=cuda_graphs)
            self._fast_frames.append(fast_frames)
        # A step changes state of the replica for the time of the step: memory, prior, embeddings.
        self._locks = [threading.Lock() for _ in self.replicas]
        # Embeddings of other rigs by replica and rows (`camera_rows`), each with the state of the
        # trained ones that it was made from. They are kept because `FastFrames` records frames
        # again if a weight moves.
        self._rig_embeds: dict[Any, tuple[Any, torch.nn.Parameter]] = {}
        self.visualizer = _build_visualizer(self.cfg)
        # Folder of the annotation files that `dataset` writes.
        self._scratch = tempfile.TemporaryDirectory(prefix="gsmap-")

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_locks": None}  # locks cannot be copied

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._locks = [threading.Lock() for _ in self.replicas]

    def _build_fast_frames(
        self, model: Any, device: torch.device, cuda_graphs: bool | None
    ) -> FastFrames | None:
        """Build the predictor that records and replays frames as CUDA graphs.

        The result is None if frames are not recorded; `_step` then calls ``test_step``. With mixed
        precision on a GPU, also switch the model to a backbone in float16.

        Args:
            model: Replica of the model.
            device: Device of the replica.
            cuda_graphs: As in the constructor.

        Raises:
            ValueError: If ``cuda_graphs`` is True on another device than a GPU, or for a model
                without a static form.
        """
        if device.type != "cuda":
            if cuda_graphs:
                raise InputError(f"cuda_graphs=True needs a GPU, got {device}: leave it out.")
            return None
        if self.amp and model.img_backbone is not None:
            model.halve_backbone()
        reason = reason_against(model)  # why the model has no static form; empty if it has one
        if cuda_graphs and reason:
            raise InputError(
                f"cuda_graphs=True cannot be used with this model: {reason}. Leave it out."
            )
        capture = CAPTURE_BY_DEFAULT if cuda_graphs is None else cuda_graphs
        if reason or not capture:
            return None
        return FastFrames(StaticFrame(model), device=device)

    def dataset(
        self,
        source: str | Path | Source | Sequence[MapSample],
        data_root: str | Path | None = None,
    ) -> "VectorizedMapDataset":
        """Create the test data set of the config, with its pipeline, from other samples.

        Samples in another annotation frame are transformed to the frame of the config. If the
        samples have no camera of the config, all cameras of the samples are used.

        Args:
            source: An annotation file, a recording of ``mapdata.inputs.open_input``, or samples in
                the annotation frame of the config.
            data_root: Folder of the image paths. By default the folder of the file, or the
                ``data_root`` of the config if an annotation file is not in the folder of its
                images.

        Raises:
            FileNotFoundError: If a file does not exist.
            ValueError: If a file cannot be used with this config.
        """
        root = None if data_root is None else Path(data_root)
        mount = self.model.mount  # annotation frame of the model, and its pose on the vehicle
        if isinstance(source, str | Path):
            source = open_annotations(source, root)
        if isinstance(source, Source):
            self._warn_about_real_images(source)
        else:
            source = Source(source, frame=mount.frame, data_root=root, ground_z_m=mount.ground_z_m)
        ann_file = Path(self._scratch.name) / f"{uuid.uuid4().hex}.arrow"
        dataset = open_dataset(self.cfg, source=source, mount=mount, ann_file=ann_file)
        self.visualizer.dataset_meta = dataset.metainfo
        return dataset

    def _warn_about_real_images(self, source: Source) -> None:
        """Warn once if a model that was trained on generated images gets other images."""
        if not self._warn_generated:
            return
        samples = source.samples
        if isinstance(samples, AnnotationFile) and samples.meta.dataset == _GENERATED:
            return
        self._warn_generated = False
        _LOGGER.warning(
            "the model was trained on generated streets only (MiniCity): on real images its maps "
            "are a trial, not a result; train it on your own data (docs/custom_data.md)."
        )

    def _fit_cameras(
        self, dataset: "VectorizedMapDataset", allow_missing_cameras: bool
    ) -> "tuple[VectorizedMapDataset, list[int] | None]":
        """Find the trained camera that each camera of a data set is treated as (`camera_rows`).

        Args:
            dataset: The data set.
            allow_missing_cameras: Whether cameras that no sample has are left out.

        Returns:
            The data set, without cameras that are left out, and for each of its cameras the index
            of the trained camera; None for a model without embeddings of cameras, or with
            embeddings of unknown cameras.
        """
        if allow_missing_cameras and dataset.cameras is not None:
            available: set[str] = set()  # cameras that a sample or more has
            for index in range(len(dataset)):
                for camera in dataset.sample(index).cameras:
                    available.add(camera.name)
            cameras = tuple(name for name in dataset.cameras if name in available)
            if cameras:
                dataset = copy.copy(dataset)  # the caller's data set keeps its cameras
                dataset.cameras = cameras
        trained = self.model.camera_names
        if trained is None:
            return dataset, None
        from gsmap.apis.rig_fit import camera_names, camera_rows  # slow to import

        if dataset.cameras is None:  # each sample would have its cameras in an order of its own
            dataset = copy.copy(dataset)
            dataset.cameras = tuple(camera_names(dataset))
        return dataset, camera_rows(dataset, trained=trained)

    @contextmanager
    def _embeddings_of(self, turn: int, rows: list[int] | None) -> "Iterator[None]":
        """Context manager in which a replica has the embeddings of other cameras.

        Args:
            turn: Index of the replica.
            rows: For each camera the index of the trained camera; None for the trained cameras.
        """
        model = self.replicas[turn]
        encoder = model.bev_encoder
        if rows is None or rows == list(range(len(encoder.cams_embeds))):
            yield
            return
        trained = encoder.cams_embeds
        version = 0 if trained.is_inference() else trained._version
        state = (trained.data_ptr(), version, model.num_trainings)
        key = (turn, tuple(rows))
        if key not in self._rig_embeds or self._rig_embeds[key][0] != state:
            embeds = torch.nn.Parameter(trained.detach()[rows])  # (V, C)
            self._rig_embeds[key] = (state, embeds)
        _, encoder.cams_embeds = self._rig_embeds[key]
        try:
            yield
        finally:
            encoder.cams_embeds = trained

    @staticmethod
    def lidar_points(dataset: "VectorizedMapDataset", index: int) -> np.ndarray | None:
        """Read the LiDAR points of a sample.

        Args:
            dataset: Data set that the method ``dataset`` has created.
            index: Index of the sample.

        Returns:
            Points (x, y, z) in metres, in the annotation frame (n, 3); None if the sample has no
            LiDAR sweep.

        Raises:
            FileNotFoundError: If the file of the sweep does not exist.
            ValueError: If the file is neither in the format of nuScenes (five float32 values per
                point) nor in the format of Argoverse 2.
        """
        lidar = dataset.sample(index).lidar
        if lidar is None:
            return None
        path = Path(dataset.data_root, lidar.path)
        if not path.is_file():
            raise FileNotFoundError(f"There is no LiDAR sweep {path}.")
        from gsmap.datasets.transforms.points import read_points

        # A point in nuScenes' format has 5 values, of which x, y and z are used.
        points = read_points(str(path), 5)[:, :3]  # (n, 3), LiDAR frame
        rotation = lidar.frame_from_lidar[:3, :3]
        translation = lidar.frame_from_lidar[:3, 3]
        return points @ rotation.T + translation

    def predict(
        self,
        dataset: "VectorizedMapDataset",
        indices: Sequence[int] | None = None,
        batch_size: int = 1,
        num_workers: int = 0,
        allow_missing_cameras: bool = False,
        on_broken: Callable[[BrokenFrame], object] | None = None,
        stream: Any = None,
        priors: "Sequence[AnyPrior]" = (),
        update_priors: bool = False,
    ) -> "Iterator[Det3DDataSample]":
        """Predict samples of a data set. Several devices take batches in turn.

        Args:
            dataset: Data set that the method ``dataset`` has created.
            indices: Indices of the samples; None predicts all.
            batch_size: Samples per forward pass.
            num_workers: Number of processes that read images.
            allow_missing_cameras: Whether absent cameras of a sample get black images. Cameras that
                no sample has are left out.
            on_broken: Function that is called with each sample that cannot be used. Such a sample
                is left out. By default, such a sample raises an error.
            stream: Drive that the samples continue, for a model with memory (`new_stream`); it may
                be used in several calls. By default each scene starts a new one. The stream is at
                most a batch ahead of the samples that are yielded.
            priors: Maps of earlier drives, one for each place, for a model that reads them. By
                default such a model starts from an empty map in each call.
            update_priors: Write each sample to ``priors`` after it is predicted.

        Yields:
            The samples in order, with ``pred_instances_3d`` on the CPU.

        Raises:
            ValueError: If a file of a sample is missing or damaged, or a camera is absent; for a
                model with memory, if frames are out of order, or there are several devices; if a
                prior is given to a model without one, or does not fit the samples.
        """
        # Batches that are computed ahead of the yielded one. One per replica keeps them busy.
        num_ahead = len(self.replicas)
        if stream is not None:
            num_ahead = 0  # the caller's stream is then at most a batch ahead of the samples
            self._temporal()  # raises an error if the model has no memory
        elif self.model.temporal is not None:
            stream = self._temporal().new_scenes()  # a memory for each scene of the samples
        maps = self._maps(priors, update=update_priors)
        dataset, rows = self._fit_cameras(dataset, allow_missing_cameras=allow_missing_cameras)
        frames = FrameDataset(dataset, blank_cameras=allow_missing_cameras)
        subset = frames if indices is None else Subset(frames, indices=indices)
        batches = DataLoader(
            subset, batch_size=batch_size, num_workers=num_workers, collate_fn=collate
        )
        with ExitStack() as stack:
            # One thread for each replica, so that it computes one batch at a time, in order.
            pools = [stack.enter_context(ThreadPoolExecutor(1)) for _ in self.replicas]
            pending: deque[Future] = deque()
            # `batch` has the usable samples, and is None if all samples are in `broken`.
            for number, (batch, broken) in enumerate(batches):
                for frame in broken:
                    if on_broken is None:
                        raise InputError(frame.reason)
                    on_broken(frame)
                if batch is not None:
                    turn = number % len(pools)
                    # A signal handler that raises here could leave a lock of the pool locked.
                    with delay_signals():
                        future = pools[turn].submit(
                            self._step, turn=turn, batch=batch, rows=rows, stream=stream, maps=maps
                        )
                        pending.append(future)
                if len(pending) > num_ahead:
                    # `result_of` waits for the result. Unlike in `Future.result`, a signal that
                    # interrupts the wait does no harm.
                    yield from result_of(pending.popleft())
            while pending:
                yield from result_of(pending.popleft())

    def new_stream(self) -> Any:
        """Create the empty memory of a drive for `predict`, whose frames must be in order.

        A repeated frame, a late frame or a frame of another scene raises an error in `predict`.

        Raises:
            ValueError: If the model has no memory, or there are several devices.
        """
        return self._temporal().new_stream()

    def _temporal(self) -> Any:
        """Part of the model that remembers earlier frames.

        Raises:
            ValueError: If the model has no such part, or there are several devices.
        """
        if self.model.temporal is None:
            raise InputError("the model has no memory (temporal): leave the stream out.")
        if len(self.devices) > 1:
            raise InputError("a model with memory runs on one device: name a single one.")
        return self.model.temporal

    def _maps(self, priors: "Sequence[AnyPrior]", update: bool) -> Any:
        """Maps that the samples of a call read; None for a model without a prior.

        Args:
            priors: Maps of earlier drives. If there are none, the samples start from an empty map.
            update: Write each sample to ``priors``.

        Raises:
            ValueError: If the model takes no prior, if a prior does not fit it, or if a model with
                a prior is on several devices.
        """
        if priors or update:
            maps = maps_for(self.model, priors, update=update)
        elif self.model.prior is not None:
            maps = self.model.prior.new_maps()
        else:
            return None
        if len(self.devices) > 1:
            raise InputError("a model with a prior runs on one device: name a single one.")
        return maps

    @torch.no_grad()
    def _step(
        self,
        turn: int,
        batch: dict[str, Any],
        rows: list[int] | None = None,
        stream: Any = None,
        maps: Any = None,
    ) -> "list[Det3DDataSample]":
        """Predict a batch on one device.

        Args:
            turn: Index of the device, and of its replica.
            batch: ``inputs`` and ``data_samples``, as `collate` returns them.
            rows: Index of the trained camera for each camera, as `_fit_cameras` returns them.
            stream: Drive or scenes of the samples, for a model with memory.
            maps: Maps that the samples read, for a model with a prior.

        Returns:
            The samples with ``pred_instances_3d``, on the CPU.
        """
        model = self.replicas[turn]
        device_type = self.devices[turn].type
        fast_frames = self._fast_frames[turn]
        with self._locks[turn], self._embeddings_of(turn, rows):
            if fast_frames is not None and fast_frames.serves(batch):
                return fast_frames(batch)  # such a model has neither a memory nor a prior
            # In these contexts, the model uses the caller's memory and maps in place of its own.
            memory = nullcontext() if stream is None else self.model.temporal.using(stream)
            prior = nullcontext() if maps is None else self.model.prior.using(maps)
            in_bfloat16 = self.amp and device_type == "cpu"
            # `half_backbone` is only set for mixed precision on a GPU (`_build_fast_frames`).
            with (
                memory,
                prior,
                matrix_products(in_tf32=model.half_backbone is not None),
                torch.autocast(device_type, enabled=in_bfloat16),
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
        """Predict one frame from images in memory. For several frames, `live` is faster.

        Args:
            images: RGB images of the cameras in uint8, by name or as a list. A camera in a list, or
                with an unknown name, is treated as the camera of the model with the nearest
                viewing direction. (H, W, 3) each
            intrinsics: Pinhole matrix of each camera, in pixels. (3, 3) each
            cam_from_frame: Transform from the frame to each camera, in metres. (4, 4) each
            frame: Frame of the transforms: ``vehicle``, ``lidar`` or ``ego``, see `LiveMap`. By
                default the frame of the config.
            allow_missing_cameras: Whether cameras of the model may be absent.
            can_bus: Vehicle signals, as `LiveMap.predict` takes them, or None. (18,)

        Returns:
            The sample with ``pred_instances_3d``, in the annotation frame of the config.

        Raises:
            TypeError: As in `LiveMap.predict`.
            ValueError: As in `LiveMap.predict`.
        """
        live = self.live(
            intrinsics,
            cam_from_frame=cam_from_frame,
            frame=frame,
            allow_missing_cameras=allow_missing_cameras,
        )
        return live.predict(images, can_bus=can_bus)

    def live(
        self,
        intrinsics: Cameras,
        cam_from_frame: Cameras,
        frame: str | None = None,
        allow_missing_cameras: bool = False,
        prior: "AnyPrior | None" = None,
        update_prior: bool = False,
    ) -> LiveMap:
        """Create a predictor that is called with the images of each frame and returns its map.

        Args:
            intrinsics: Pinhole matrix of each camera, in pixels. (3, 3) each
            cam_from_frame: Transform from the frame to each camera, in metres. (4, 4) each
            frame: Frame of the transforms: ``vehicle``, ``lidar`` or ``ego``, see `LiveMap`. By
                default the frame of the config.
            allow_missing_cameras: Whether cameras of the model may be absent.
            prior: Map of earlier drives, for a model that reads one.
            update_prior: Write each frame to ``prior`` after it is predicted.

        Returns:
            The predictor. It uses the model of this inferencer, not a copy.
        """
        return LiveMap(
            self,
            intrinsics=intrinsics,
            cam_from_frame=cam_from_frame,
            frame=frame,
            allow_missing_cameras=allow_missing_cameras,
            prior=prior,
            update_prior=update_prior,
        )

    def elements(self, data_sample: "Det3DDataSample") -> MapElements:
        """Map elements of a predicted sample: polylines in metres, labels, scores, Gaussians."""
        return elements_of_predictions(data_sample.pred_instances_3d)

    def vectors(self, data_sample: "Det3DDataSample") -> list[dict[str, Any]]:
        """Map elements of a predicted sample in the format of the results JSON.

        The class names are read from the data set that `dataset` created last.
        """
        return vectors_of(self.elements(data_sample), self.visualizer.dataset_meta["classes"])

    def draw(self, data_sample: "Det3DDataSample", **options: Any) -> "Figure":
        """Draw a predicted sample; options as in ``MapVisualizer.draw_sample``."""
        return self.visualizer.draw_sample(data_sample, **options)

    def __call__(
        self,
        source: str | Path | Source | Sequence[MapSample],
        data_root: str | Path | None = None,
        stream: Any = None,
    ) -> "list[Det3DDataSample]":
        """Predict all samples of a source.

        Args:
            source: Samples, as `dataset` takes them.
            data_root: Folder of the image paths, as `dataset` takes it.
            stream: Drive that the samples continue, as `predict` takes it.

        Returns:
            The samples in order, with ``pred_instances_3d`` on the CPU, in the annotation frame of
            the model.
        """
        return list(self.predict(self.dataset(source, data_root=data_root), stream=stream))
