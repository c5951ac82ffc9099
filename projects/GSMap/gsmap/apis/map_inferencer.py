"""A trained model on recorded samples: map elements and pictures out."""

import logging
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from mmdet3d.registry import DATASETS, MODELS
from mmdet3d.structures import Det3DDataSample
from mmengine.config import Config
from mmengine.dataset import pseudo_collate
from torch.utils.data import DataLoader, Dataset, Subset

from gsmap.apis.blank_cameras import BlankCameraDataset
from gsmap.apis.checkpoint import adopt_settings, load_weights
from gsmap.apis.info_file import read_info_file
from gsmap.datasets.annotations.file import write_annotations
from gsmap.datasets.annotations.record import CLASSES, AnnotationMeta, MapSample
from gsmap.datasets.transforms.points import read_points
from gsmap.datasets.vectorized_map_dataset import VectorizedMapDataset
from gsmap.engine.launch import read_config
from gsmap.engine.named_models import named_models
from gsmap.evaluation.map_metric import MapMetric
from gsmap.visualization.map_visualizer import MapVisualizer

_LOGGER = logging.getLogger(__name__)
_PATTERNS = ("*.arrow", "*.pkl")


def find_sample_file(source: str | Path) -> Path:
    """Return the file that describes the samples at ``source``.

    Args:
        source: An annotation file (``.arrow``), an info file of mmdet3d (``.pkl``), or a folder
            with just one of them.

    Returns:
        The file.

    Raises:
        FileNotFoundError: If there is none.
        ValueError: If a folder holds several, or the file is of another kind.
    """
    source = Path(source)
    if source.is_dir():
        found = sorted(path for pattern in _PATTERNS for path in source.glob(pattern))
        if not found:
            raise FileNotFoundError(f"{source} holds no {' or '.join(_PATTERNS)} file.")
        if len(found) > 1:
            names = ", ".join(path.name for path in found)
            raise ValueError(f"{source} holds several sample files ({names}): name one of them.")
        return found[0]
    if not source.is_file():
        raise FileNotFoundError(f"There is no sample file or folder {source}.")
    if source.suffix not in (".arrow", ".pkl"):
        raise ValueError(f"{source} must be an annotation file (.arrow) or an info file (.pkl).")
    return source


def select_samples(
    tokens: Sequence[str], wanted: Sequence[str] | None = None, max_num: int | None = None
) -> list[int]:
    """Choose samples by token, and of these a number spread evenly.

    Args:
        tokens: Tokens of all samples.
        wanted: Tokens to keep, in this order; None keeps all.
        max_num: Largest number of samples; None keeps all.

    Returns:
        Indices into ``tokens``.

    Raises:
        ValueError: If a wanted token is not there, or ``max_num`` is smaller than 1.
    """
    chosen = list(range(len(tokens)))
    if wanted is not None:
        position = {token: index for index, token in enumerate(tokens)}
        unknown = [token for token in wanted if token not in position]
        if unknown:
            raise ValueError(f"No sample has the token {unknown[0]!r}; there are {len(tokens)}.")
        chosen = [position[token] for token in wanted]
    return [chosen[i] for i in spread_evenly(len(chosen), max_num)]


def spread_evenly(count: int, max_num: int | None = None) -> list[int]:
    """Return at most ``max_num`` of the indices below ``count``, spread evenly.

    Raises:
        ValueError: If ``max_num`` is smaller than 1.
    """
    if max_num is None or max_num >= count:
        return list(range(count))
    if max_num < 1:
        raise ValueError(f"max_num must be >= 1, got {max_num}.")
    return np.linspace(0, count - 1, max_num).round().astype(int).tolist()


def _lies_with_its_images(path: Path, dataset: VectorizedMapDataset) -> bool:
    """Whether the first image of an annotation file is found from the file's own folder."""
    cameras = dataset.sample(0).cameras
    return bool(cameras) and (path.parent / cameras[0].path).is_file()


class MapInferencer:
    """Runs a trained model on samples, through the pipeline that the config tests with.

    Args:
        config: Config file of the model, a ``Config``, or the name of a model
            (``engine/named_models.py``), such as ``gsmap_r18_minicity``.
        checkpoint: Its checkpoint, or such a name. None means the named model's, and without a name
            the initial weights (for trying out a pipeline).
        device: Where to run; a GPU if there is one.
        cfg_options: Overrides of the config, by dotted name.

    Raises:
        FileNotFoundError: If the config or the checkpoint does not exist.
        ValueError: If the checkpoint belongs to another architecture, or cannot be read.
    """

    def __init__(
        self,
        config: str | Path | Config,
        checkpoint: str | Path | None = None,
        device: str | torch.device | None = None,
        cfg_options: dict | None = None,
    ):
        self.cfg = read_config(config, cfg_options)
        if checkpoint is None and str(config) in named_models():
            checkpoint = str(config)
        if checkpoint is not None:
            for line in adopt_settings(self.cfg, checkpoint, cfg_options):
                _LOGGER.warning(line)
        self.model = MODELS.build(self.cfg.model)
        if checkpoint is not None:
            load_weights(self.model, checkpoint)
        self.device = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
        self.model.to(self.device).eval()
        self.visualizer = self._build_visualizer()
        self._scratch = tempfile.TemporaryDirectory(prefix="gsmap-")
        self._files = 0

    def _build_visualizer(self) -> MapVisualizer:
        """Build a visualizer with the config's options and without its backends."""
        options = dict(self.cfg.get("visualizer") or {})
        kind = str(options.pop("type", "MapVisualizer")).split(".")[-1]
        options = options if kind == "MapVisualizer" else {}
        for name in ("name", "vis_backends", "save_dir"):
            options.pop(name, None)
        return MapVisualizer(name=f"inferencer-{id(self)}", **options)

    def dataset(
        self,
        source: str | Path | Sequence[MapSample],
        data_root: str | Path | None = None,
        allow_missing_cameras: bool = False,
    ) -> VectorizedMapDataset:
        """Open samples as the config's test data set.

        Args:
            source: An annotation file, an info file of mmdet3d, a folder with one of them, or
                samples in the frame of the config.
            data_root: Folder that image paths start from; by default that of the file, or the
                config's where an annotation file lies apart from its images.
            allow_missing_cameras: Whether an info file may name images that do not exist.

        Returns:
            The data set, with the test pipeline.

        Raises:
            FileNotFoundError: If a file does not exist.
            ValueError: If a file cannot be used with this config; the message says why.
        """
        if isinstance(source, str | Path):
            path = find_sample_file(source)
            if path.suffix == ".pkl":
                data_root = path.parent if data_root is None else data_root
                samples = read_info_file(path, data_root, allow_missing_cameras)
                path = self._annotation_file(samples, "lidar")
        else:
            frame = self.cfg.test_dataloader.dataset.get("frame") or "lidar"
            path = self._annotation_file(source, frame)
        options: dict[str, Any] = dict(self.cfg.test_dataloader.dataset)
        options |= {"ann_file": str(path.resolve()), "test_mode": True, "split": None, "dim": None}
        if data_root is not None:
            options["data_root"] = str(Path(data_root).resolve())
        dataset = DATASETS.build(options)
        if data_root is None and _lies_with_its_images(path, dataset):
            dataset.data_root = str(path.resolve().parent)
        self.visualizer.dataset_meta = dataset.metainfo
        return dataset

    def _annotation_file(self, samples: Sequence[MapSample], frame: str) -> Path:
        """Write samples to an annotation file that lives as long as the inferencer."""
        options = self.cfg.test_dataloader.dataset
        grid = options.get("grid") or self.cfg.model.grid
        meta = AnnotationMeta(
            dataset="samples",
            frame=frame,
            split="test",
            classes=tuple(options.get("classes") or CLASSES),
            x_range=tuple(grid["x_range"]),
            y_range=tuple(grid["y_range"]),
            dim=max((i.points.shape[1] for s in samples for i in s.instances or ()), default=2),
            command="tools/infer.py",
        )
        self._files += 1
        path = Path(self._scratch.name) / f"samples{self._files}.arrow"
        write_annotations(path, meta, samples)
        return path

    @staticmethod
    def lidar_points(dataset: VectorizedMapDataset, index: int) -> np.ndarray | None:
        """Return a sample's LiDAR points in the annotation frame, in metres, if it has a sweep.

        Args:
            dataset: From ``dataset()``.
            index: Index of the sample.

        Returns:
            Points (x, y, z). (n, 3)

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
        matrix = lidar.frame_from_lidar
        return read_points(str(path), 5)[:, :3] @ matrix[:3, :3].T + matrix[:3, 3]

    @torch.no_grad()
    def predict(
        self,
        dataset: VectorizedMapDataset,
        indices: Sequence[int] | None = None,
        batch_size: int = 1,
        num_workers: int = 0,
        allow_missing_cameras: bool = False,
    ) -> Iterator[Det3DDataSample]:
        """Run the model.

        Args:
            dataset: From ``dataset()``.
            indices: Which samples; all by default.
            batch_size: Samples per forward pass.
            num_workers: Processes that read images.
            allow_missing_cameras: Whether cameras that a sample lacks are left blank.

        Yields:
            The samples in order, with ``pred_instances_3d`` on the CPU.

        Raises:
            ValueError: If a file of a sample is missing or damaged, or a camera is absent.
        """
        chosen: Dataset = BlankCameraDataset(dataset, allow_missing_cameras)
        if indices is not None:
            chosen = Subset(chosen, list(indices))
        loader = DataLoader(
            chosen, batch_size=batch_size, num_workers=num_workers, collate_fn=pseudo_collate
        )
        for batch in loader:
            for sample in self.model.test_step(batch):
                yield sample.cpu()

    def write(self, path: str | Path, data_samples: Sequence[Det3DDataSample]) -> None:
        """Write predictions as JSON, in the form that ``tools/test.py --out`` writes.

        Args:
            path: File to write.
            data_samples: Samples from ``predict``.
        """
        metric = MapMetric(eval=(), out_file=str(path))
        metric.dataset_meta = self.visualizer.dataset_meta
        metric.process(None, [sample.to_dict() for sample in data_samples])
        metric.evaluate(len(data_samples))

    def draw(self, data_sample: Det3DDataSample, **options: Any) -> Figure:
        """Compose a predicted sample's picture; options as in ``MapVisualizer.draw_sample``."""
        return self.visualizer.draw_sample(data_sample, **options)

    def __call__(
        self, source: str | Path | Sequence[MapSample], data_root: str | Path | None = None
    ) -> list[Det3DDataSample]:
        """Predict all samples of a source; arguments as in ``dataset``."""
        return list(self.predict(self.dataset(source, data_root)))
