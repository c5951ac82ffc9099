"""Cameras that a model was trained on, and inputs with other cameras.

A BEV encoder with embeddings of cameras has one for each camera of the training, in their order.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mmengine.config import Config
from mmengine.hooks import Hook
from mmengine.model import is_model_wrapper
from mmengine.runner import Runner
from torch import nn

from gsmap.apis.rig_fit import camera_rows, training_facts
from gsmap.checkpoints.reading import Checkpoint
from gsmap.checkpoints.settings import innermost_datasets
from gsmap.engine.launch import read_config
from gsmap.engine.run_log import innermost
from gsmap.utils.errors import InputError

if TYPE_CHECKING:
    from gsmap.datasets.vectorized_map_dataset import VectorizedMapDataset


def trained_cameras(
    model: nn.Module,
    config: str | Path | Config,
    cfg: Config,
    path: str | Path | None,
    checkpoint: Checkpoint | None,
) -> tuple[str, ...] | None:
    """Find the names of the cameras that a model was trained on.

    They are read from the checkpoint. If it does not name them, they are the cameras of the config
    of a named model, or else of the training data, or the test data, in ``config``. The overrides
    of a command are the last source, because they may select cameras of the model.

    Args:
        model: The model.
        config: Config file or name, or a ``Config``, without overrides.
        cfg: The config with overrides.
        path: File of the weights; None for initial weights.
        checkpoint: Contents of the file; None for initial weights.

    Returns:
        Names in the order of the embeddings; None if the model has no embeddings of cameras, or
        no source names as many cameras as it has embeddings.
    """
    embeds = getattr(getattr(model, "bev_encoder", None), "cams_embeds", None)
    if embeds is None:
        return None
    facts: dict[str, Any] = {}
    if checkpoint is not None:
        facts = training_facts(path, dataset_meta=checkpoint.dataset_meta)
    names = facts.get("cameras")
    if names is None:
        names = _cameras_of_config(read_config(config))
    for cameras in (names, _cameras_of_config(cfg)):
        if cameras is not None and len(cameras) == len(embeds):
            return tuple(cameras)
    return None


def _cameras_of_config(cfg: Config) -> Sequence[str] | None:
    """Names of the cameras of the training data of a config, or else of its test data."""
    for part in ("train", "test"):
        dataset = (cfg.get(f"{part}_dataloader") or {}).get("dataset") or {}
        for inner_dataset in innermost_datasets(dataset):
            if inner_dataset.get("cameras"):
                return inner_dataset["cameras"]
    return None


def choose_cameras(
    model: nn.Module, trained: Sequence[str] | None, wanted: Sequence[str] | None
) -> Sequence[str] | None:
    """Give a model the embeddings of some of its cameras, in the wanted order.

    Args:
        model: The model with its weights; changed in place.
        trained: Names of its cameras, as `trained_cameras` returns them.
        wanted: Names of the cameras in the config. If one is not a camera of the model, nothing is
            changed: the cameras of samples are then assigned by direction (`camera_rows`).

    Returns:
        Names of the cameras in the order of the embeddings; None if they are unknown.
    """
    if trained is None or not wanted or not set(wanted) <= set(trained):
        return trained
    use_embeddings(model, rows=[list(trained).index(name) for name in wanted])
    return tuple(wanted)


def use_embeddings(model: Any, rows: Sequence[int]) -> nn.Parameter:
    """Replace the embeddings of a model's cameras by a selection of them.

    Args:
        model: A model with embeddings of cameras; changed in place.
        rows: Index of the trained camera for each of the V cameras.

    Returns:
        The replaced embeddings.
    """
    trained: nn.Parameter = model.bev_encoder.cams_embeds  # (V_old, C)
    if list(rows) != list(range(len(trained))):
        model.bev_encoder.cams_embeds = nn.Parameter(trained.detach()[list(rows)])  # (V, C)
    return trained


def use_cameras_of(model: Any, dataset: "VectorizedMapDataset") -> None:
    """Give a model of `load_model` the embeddings of a data set's cameras, in place.

    Raises:
        ValueError: If a camera cannot be assigned (`camera_rows`).
    """
    if model.camera_names is not None:
        use_embeddings(model, rows=camera_rows(dataset, trained=model.camera_names))


class TrainedCamerasHook(Hook):
    """Hook that gives the cameras of the test data the embeddings of their trained cameras.

    The embeddings are replaced only during an iteration, so that other hooks may replace all
    weights around a test.

    Args:
        config: Config file or name, as in `trained_cameras`.
        path: File of the weights.
        checkpoint: Contents of the file.
    """

    def __init__(self, config: str | Path | Config, path: Path, checkpoint: Checkpoint) -> None:
        self._config = config
        self._path = path
        self._checkpoint = checkpoint
        self._rows: list[int] | None = None  # index of the trained camera for each camera
        self._trained: Any = None  # embeddings of the trained cameras, during an iteration

    def before_test(self, runner: Runner) -> None:
        """Assign a trained camera to each camera of the test data.

        Raises:
            ValueError: If a camera cannot be assigned (`camera_rows`), or if several data sets
                have their cameras in different orders.
        """
        trained = trained_cameras(
            _unwrapped(runner.model),
            config=self._config,
            cfg=runner.cfg,
            path=self._path,
            checkpoint=self._checkpoint,
        )
        if trained is None:
            return
        assignments = []  # for each data set, the trained cameras of its cameras
        for dataset in innermost(runner.test_dataloader.dataset):
            if hasattr(dataset, "cameras"):  # a data set class of a user may not name its cameras
                assignments.append(camera_rows(dataset, trained=trained))
        if not assignments:
            return
        if any(rows != assignments[0] for rows in assignments):
            raise InputError(
                "the test data sets have other cameras or other orders of cameras: give all of "
                "them equal `cameras`, or test each alone."
            )
        self._rows = assignments[0]

    def before_test_iter(self, runner: Runner, batch_idx: int, data_batch: Any = None) -> None:
        """Select the embeddings of the cameras.

        Args:
            runner: Runner of the test.
            batch_idx: Not used.
            data_batch: Not used.
        """
        if self._rows is not None:
            self._trained = use_embeddings(_unwrapped(runner.model), rows=self._rows)

    def after_test_iter(
        self, runner: Runner, batch_idx: int, data_batch: Any = None, outputs: Any = None
    ) -> None:
        """Restore the embeddings of the trained cameras.

        Args:
            runner: Runner of the test.
            batch_idx: Not used.
            data_batch: Not used.
            outputs: Not used.
        """
        if self._rows is not None:
            _unwrapped(runner.model).bev_encoder.cams_embeds = self._trained


def _unwrapped(model: Any) -> Any:
    """Model without the wrapper of a distributed test."""
    return model.module if is_model_wrapper(model) else model
