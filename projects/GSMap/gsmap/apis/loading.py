"""A trained model by its name, or by its config and checkpoint."""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mmdet3d.registry import MODELS
from mmengine.config import Config

from gsmap.checkpoints.building import building
from gsmap.checkpoints.named_models import named_models
from gsmap.checkpoints.reading import Checkpoint, adopt_settings, load_weights, read_checked
from gsmap.datasets.annotations.record import RANGES
from gsmap.datasets.source import Mount
from gsmap.engine.launch import read_config
from gsmap.structures.rigid import is_rigid
from gsmap.utils.errors import InputError
from gsmap.utils.model_facts import MOUNT, RIG

_LOGGER = logging.getLogger(__name__)
_USUAL = ("nuscenes", "minicity", "av2")  # data sets whose frames lie where the usual ones do
_FARTHEST_M, _LARGEST_PX = 100.0, 1e5


def load_model(
    config: str | Path | Config,
    checkpoint: str | Path | None = None,
    device: str | torch.device = "cpu",
    cfg_options: dict | None = None,
) -> Any:
    """Build a model and load its weights, ready to predict.

    Args:
        config: Config file, a ``Config``, or the name of a model (``list_models``).
        checkpoint: File or name. None means the named model's; without a name, initial weights.
        device: Where the model is.
        cfg_options: Overrides of the config, by dotted name.

    Returns:
        The torch module, in evaluation mode; ``model.cfg`` is its config, as it was trained,
        ``model.mount`` the place of its annotation frame in the vehicle that it was trained on,
        ``model.rig`` its cameras (width, height, fx, fy, cx, cy in pixels, by name), ``model.seen``
        the data set, as far as it is known, and ``model.without_signals`` whether
        that is known to have had none of the vehicle's signals.

    Raises:
        FileNotFoundError: If the config or the checkpoint does not exist.
        ValueError: If the checkpoint belongs to another architecture, or cannot be read.
    """
    cfg = read_config(config, cfg_options)
    if checkpoint is None and str(config) in named_models():
        checkpoint = str(config)
    read = None if checkpoint is None else read_checked(checkpoint)
    with building(cfg):
        if checkpoint is not None:
            for line in adopt_settings(cfg, checkpoint, cfg_options, read):
                _LOGGER.warning(line)
        model = MODELS.build(cfg.model)
    if checkpoint is not None:
        load_weights(model, checkpoint, read)
    model.cfg = cfg
    model.mount = _mount_of(cfg, read, checkpoint)
    # of checkpoints that say how they were trained
    model.without_signals = bool(read and read.settings is not None and not read.can_bus)
    model.seen = _seen_by(read, checkpoint)
    model.rig = {} if read is None else trained_rig(read)
    if model.temporal is not None:
        model.temporal.name = f"{cfg.filename or 'a config'} with {checkpoint or 'initial weights'}"
    return model.to(device).eval()


def trained_rig(read: Checkpoint) -> dict[str, tuple[float, ...]]:
    """Return width, height, fx, fy, cx and cy of the cameras of a model's training, by name.

    What is no such camera is left out: it is a stranger's word, and only spoils a picture.
    """
    said = read.dataset_meta.get(RIG)
    found = {}
    for name, values in said.items() if isinstance(said, Mapping) else ():
        numbers = values if isinstance(values, list | tuple) else ()
        if len(numbers) != 6 or not all(isinstance(v, int | float) for v in numbers):
            continue
        if all(0 < v < _LARGEST_PX for v in numbers[:4]) and np.isfinite(numbers).all():
            found[str(name)] = tuple(float(v) for v in numbers)
    return found


def _seen_by(read: Checkpoint | None, checkpoint: object) -> str:
    """Return the data set that a model was trained on; the models that ship saw MiniCity."""
    if read is None:
        return ""
    model = named_models().get(str(checkpoint))
    usual = "minicity" if model is not None and not model.address else ""
    return str(read.dataset_meta.get("dataset", usual))


def _mount_of(cfg: Config, read: Checkpoint | None, path: object) -> Mount:
    """Return where a model's frame lies in the vehicle: as its checkpoint says, or as is usual.

    Raises:
        ValueError: If the checkpoint says what cannot be.
    """
    options = cfg.test_dataloader.dataset
    frame = options.get("frame") or "lidar"
    said = read.dataset_meta if read else {}
    if said.get("frame", frame) != frame or frame not in RANGES:
        return Mount(frame)
    height, matrix = said.get("ground_z_m"), said.get(MOUNT)
    height = options.get("ground_z_m") if height is None else height
    if height is None and matrix is None:
        if said.get("dataset", _USUAL[0]) not in _USUAL:
            _LOGGER.warning(
                "%s does not say how high its frame %r lies above the road (train it on files with "
                "ground_z_m or ego_from_frame): the usual %.2f m are taken.",
                path, frame, Mount(frame).matrix[2, 3],
            )  # fmt: skip
        return Mount(frame)
    try:
        place = None if matrix is None else np.array(matrix, np.float64)
        height = None if height is None else float(height)
        bounded = place is None or (place.shape == (4, 4) and abs(place).max() < _FARTHEST_M)
        if not bounded or not (place is None or is_rigid(place)) or abs(height or 0.0) > 10:
            raise InputError("no place on a vehicle")
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{path} was not loaded: where its frame lies in the vehicle makes no sense ({error})."
        ) from error
    return Mount(frame, height, place)
