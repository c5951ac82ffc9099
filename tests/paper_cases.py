"""Configs and heads that tests of the papers' numbers share."""

from functools import cache
from pathlib import Path

from mmdet3d.registry import MODELS
from mmengine.config import Config
from mmengine.registry import init_default_scope
from torch import nn

import gsmap.registered  # noqa: F401
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
    return MODELS.build({**shared, **cfg.model.map_head})
