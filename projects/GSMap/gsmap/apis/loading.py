"""Trained models by name, or by config and checkpoint."""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mmdet3d.registry import MODELS
from mmengine.config import Config

from gsmap.checkpoints.building import building
from gsmap.checkpoints.named_models import find_checkpoint, named_models
from gsmap.checkpoints.reading import Checkpoint, adopt_settings, load_weights, read_checked
from gsmap.checkpoints.settings import innermost_datasets
from gsmap.datasets.annotations.record import RANGES
from gsmap.datasets.source import Mount
from gsmap.engine.launch import read_config
from gsmap.structures.rigid import is_rigid
from gsmap.utils.errors import InputError
from gsmap.utils.model_facts import MOUNT, RIG

_LOGGER = logging.getLogger(__name__)
# Data sets with the usual mount of a frame. A mount is the pose of the annotation frame on the
# vehicle.
_USUAL_DATASETS = ("nuscenes", "minicity", "av2")
# Limits of the values that a checkpoint may contain.
_FARTHEST_M = 100.0  # of the entries of a mount
_HIGHEST_M = 10.0  # of the height of the ground
_LARGEST_PX = 1e5  # of the sizes and intrinsics of cameras


def load_model(
    config: str | Path | Config,
    checkpoint: str | Path | None = None,
    device: str | torch.device = "cpu",
    cfg_options: dict | None = None,
) -> Any:
    """Build a model and load its weights for prediction.

    Args:
        config: Config file, a ``Config``, or the name of a model (``list_models``).
        checkpoint: File of the weights, or name of a model. None selects the weights of the model
            that ``config`` names, or initial weights if it names no model.
        device: Device of the model.
        cfg_options: Overrides of the config, by dotted name.

    Returns:
        The model in evaluation mode, with these additional attributes:

        * ``cfg``: Its config, with the settings of its training.
        * ``mount``: Pose of its annotation frame on the vehicle of the training data (`Mount`).
        * ``rig``: Cameras of the training data by name: width, height, fx, fy, cx, cy in pixels.
        * ``camera_names``: Cameras of the encoder's embeddings, in order; None if unknown.
        * ``training_dataset``: Name of the training's data set; empty if unknown.
        * ``without_signals``: Whether the training data is known to lack vehicle signals (CAN bus).

        If the cameras of the test data are cameras of the training, the model has the embeddings
        of these, in their order; otherwise it has those of the training.

    Raises:
        FileNotFoundError: If the config or the checkpoint does not exist.
        ValueError: If the config or the checkpoint cannot be read, if the checkpoint belongs to
            another architecture, or if its settings or its mount are not valid.
    """
    from gsmap.apis.trained_cameras import choose_cameras, trained_cameras  # slow to import

    cfg = read_config(config, cfg_options)
    if checkpoint is None and str(config) in named_models():
        checkpoint = str(config)
    # The file is read once, and the functions below share its contents.
    file = None if checkpoint is None else find_checkpoint(checkpoint)
    contents = None if file is None else read_checked(file)
    with building(cfg):  # adds the names of the config and of its parts to errors
        if checkpoint is not None:
            # A line for each setting that differs between the config and the checkpoint.
            for line in adopt_settings(
                cfg, path=checkpoint, cfg_options=cfg_options, checkpoint=contents
            ):
                _LOGGER.warning(line)
        model = MODELS.build(cfg.model)
    if checkpoint is not None:
        load_weights(model, path=checkpoint, checkpoint=contents)
    model.cfg = cfg
    if note := zero_signals_note(model, cfg):
        _LOGGER.warning(note)
    trained = trained_cameras(model, config=config, cfg=cfg, path=file, checkpoint=contents)
    model.camera_names = choose_cameras(
        model, trained=trained, wanted=cfg.test_dataloader.dataset.get("cameras")
    )
    model.mount = _training_mount(cfg, contents=contents, path=checkpoint)
    model.without_signals = contents is not None and contents.without_signals
    model.training_dataset = _training_dataset(contents, name=checkpoint)
    model.rig = {} if contents is None else trained_rig(contents)
    if model.temporal is not None:
        # A stream that was saved continues only with a model of equal name.
        model.temporal.name = f"{cfg.filename or 'a config'} with {checkpoint or 'initial weights'}"
    return model.to(device).eval()


def trained_rig(checkpoint: Checkpoint) -> dict[str, tuple[float, ...]]:
    """Cameras of the training data of a model.

    Values that are not valid are left out without an error: only pictures depend on them.

    Args:
        checkpoint: Contents of the checkpoint.

    Returns:
        Width, height, fx, fy, cx and cy in pixels, by the name of the camera.
    """
    rig = checkpoint.dataset_meta.get(RIG)
    cameras: dict[str, tuple[float, ...]] = {}
    if not isinstance(rig, Mapping):
        return cameras
    for name, numbers in rig.items():
        if not isinstance(numbers, list | tuple) or len(numbers) != 6:
            continue
        if not all(isinstance(number, int | float) for number in numbers):
            continue
        lengths = numbers[:4]  # all but the principal point
        is_bounded = all(abs(number) < _LARGEST_PX for number in numbers)  # refuses NaN as well
        if is_bounded and all(length > 0 for length in lengths):
            cameras[str(name)] = tuple(map(float, numbers))
    return cameras


def _training_dataset(contents: Checkpoint | None, name: object) -> str:
    """Name of the data set that a model was trained on; empty if unknown.

    Args:
        contents: Contents of the checkpoint; None for initial weights.
        name: Path of the checkpoint, or name of a model. Models that ship are trained on MiniCity;
            a file with the name of one is a copy of it.
    """
    if contents is None:
        return ""
    model = named_models().get(Path(str(name)).name.removesuffix(".pth"))
    is_shipped = model is not None and not model.address  # others have a download address
    default = "minicity" if is_shipped else ""
    return str(contents.dataset_meta.get("dataset", default))


def zero_signals_note(model: Any, cfg: Config) -> str:
    """Say that the vehicle signals of the test data are zero; empty if the model reads none.

    Args:
        model: The built model.
        cfg: Its config, with the settings of its training.
    """
    reads_signals = "can_bus" in getattr(model.bev_encoder, "calibration", ())
    datasets = innermost_datasets(cfg.test_dataloader.dataset)
    if not reads_signals or not any(dataset.get("zero_signals") for dataset in datasets):
        return ""
    return (
        "the model was trained without vehicle signals (can_bus), so those of all samples are "
        "zero; test_dataloader.dataset.zero_signals=False uses them."
    )


def _training_mount(cfg: Config, contents: Checkpoint | None, path: object) -> Mount:
    """Pose of a model's annotation frame on the vehicle of its training data.

    Args:
        cfg: Config of the model.
        contents: Contents of the checkpoint; None for initial weights.
        path: Path of the checkpoint, for messages.

    Returns:
        The mount in the checkpoint, or the usual mount of the frame if the checkpoint has no mount
        or has the mount of another frame. The height of the road may come from the config instead.

    Raises:
        ValueError: If the mount in the checkpoint is not possible on a vehicle.
    """
    options = cfg.test_dataloader.dataset
    frame = options.get("frame") or "lidar"
    meta = contents.dataset_meta if contents else {}
    # A mount in the checkpoint is the pose of the frame that the checkpoint names. It is not used
    # if the config has another frame.
    names_other_frame = meta.get("frame", frame) != frame
    if names_other_frame or frame not in RANGES:  # `RANGES` has the known frames
        return Mount(frame)
    height = meta.get("ground_z_m")  # z of the road in the frame, in metres
    if height is None:
        height = options.get("ground_z_m")
    matrix = meta.get(MOUNT)  # transform from the frame to the ground below the rear axle
    if height is None and matrix is None:
        # Older files do not record the data set. It is then taken to be a usual one.
        dataset = meta.get("dataset", _USUAL_DATASETS[0])
        if dataset not in _USUAL_DATASETS:
            _LOGGER.warning(
                "%s does not say how high its frame %r lies above the road (train it on files with "
                "ground_z_m or ego_from_frame): the usual %.2f m are taken.",
                path, frame, Mount(frame).matrix[2, 3],
            )  # fmt: skip
        return Mount(frame)
    try:
        height = None if height is None else _check_height(height)
        matrix = None if matrix is None else _check_mount(matrix)
    except (TypeError, ValueError, OverflowError) as error:  # the values may be no numbers
        raise InputError(
            f"{path} was not loaded: the place of its frame in the vehicle is impossible ({error})."
        ) from error
    return Mount(frame, ground_z_m=height, ground_from_frame=matrix)


def _check_height(value: Any) -> float:
    """Convert the height of the ground in a file to a number; ValueError if it is not possible.

    The messages of `_check_height` and `_check_mount` are a part of a message of `_training_mount`.
    """
    height = float(value)
    if not abs(height) <= _HIGHEST_M:  # refuses NaN as well
        raise InputError(f"the ground is not within {_HIGHEST_M:g} m of it")
    return height


def _check_mount(value: Any) -> np.ndarray:
    """Convert a pose in a file to a matrix (4, 4); ValueError if it is not possible."""
    matrix = np.array(value, dtype=np.float64)
    is_near = matrix.shape == (4, 4) and abs(matrix).max() < _FARTHEST_M  # refuses NaN as well
    if not is_near or not is_rigid(matrix):
        raise InputError(f"it is not a rigid transform with values below {_FARTHEST_M:g} m")
    return matrix
