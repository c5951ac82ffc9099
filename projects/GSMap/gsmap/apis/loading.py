"""A trained model by its name, or by its config and checkpoint."""

import logging
from pathlib import Path
from typing import Any

import torch
from mmdet3d.registry import MODELS
from mmengine.config import Config

from gsmap.checkpoints.building import building
from gsmap.checkpoints.named_models import named_models
from gsmap.checkpoints.reading import adopt_settings, load_weights
from gsmap.engine.launch import read_config

_LOGGER = logging.getLogger(__name__)


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
        The torch module, in evaluation mode; ``model.cfg`` is its config, as it was trained.

    Raises:
        FileNotFoundError: If the config or the checkpoint does not exist.
        ValueError: If the checkpoint belongs to another architecture, or cannot be read.
    """
    cfg = read_config(config, cfg_options)
    if checkpoint is None and str(config) in named_models():
        checkpoint = str(config)
    with building(cfg):
        if checkpoint is not None:
            for line in adopt_settings(cfg, checkpoint, cfg_options):
                _LOGGER.warning(line)
        model = MODELS.build(cfg.model)
    if checkpoint is not None:
        load_weights(model, checkpoint)
    model.cfg = cfg
    if model.temporal is not None:
        model.temporal.name = f"{cfg.filename or 'a config'} with {checkpoint or 'initial weights'}"
    return model.to(device).eval()
