"""Configs and heads that tests of the papers' numbers share."""

from functools import cache
from pathlib import Path

import pytest
from mmdet3d.registry import MODELS
from mmengine.config import Config
from mmengine.registry import init_default_scope
from torch import nn
from unset_weights import unset_weights

import gsmap.registered  # noqa: F401
from gsmap.engine.launch import check_config, read_config
from gsmap.structures.grid import BEVGrid

REPO = Path(__file__).resolve().parents[1]


@cache
def load(name: str) -> Config:
    """Return a config that all tests share; none changes it."""
    return Config.fromfile(REPO / name, import_custom_modules=False)


@cache
def head_of(name: str) -> nn.Module:
    """Return a config's head, which all tests share; none changes it."""
    init_default_scope("mmdet3d")
    cfg = load(name)
    shared = {"grid": BEVGrid(**cfg.grid), "classes": cfg.classes}
    with unset_weights():
        return MODELS.build({**shared, **cfg.model.map_head})


def require_target(config: str, transform: str, kind: str) -> None:
    """Check that a config is refused without a transform whose targets a part needs.

    Args:
        config: The config, whose pipeline has the transform.
        transform: Registry name of the transform.
        kind: Registry name of the head, loss or auxiliary head.
    """
    cfg = read_config(REPO / config)
    check_config(cfg)
    dataset = cfg.train_dataloader.dataset
    dataset.pipeline = [step for step in dataset.pipeline if step.type != transform]
    with pytest.raises(ValueError, match=f"{kind} needs the targets of {transform}: add it"):
        check_config(cfg)
