"""Training settings of the releases: one row a config, to be held against ours.

Each row says where its release has them; numbers of the papers where there is no release. Equal
settings of a family stand here once, as ``MAPTR``; each method's rows in its own folder.
"""

import importlib
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from mmengine.config import Config
from torch import nn
from torch.nn.modules.batchnorm import _BatchNorm

REPO = Path(__file__).resolve().parents[1]
METHODS = REPO / "tests/methods"
IMAGE_STEPS = {"DistortImages": "distort", "ScaleImages": "scale", "CropImages": "crop"}


@dataclass(frozen=True)
class Settings:
    """Settings of a training.

    Args:
        rates: Learning rate of each group of parameters, by the part of the model.
        decay: Weight decay.
        clip: Largest norm of the gradients; None does not clip.
        warm_up: Iterations, and the share of the rate at the first.
        schedule: Kind of the scheduler after it, with its numbers.
        epochs: Number of epochs.
        batch: Samples per GPU.
        evaluated: Epochs between two validations.
        images: What is done to images before they are packed, in its order.
        grid_mask: Whether training hides a grid of each image.
        drop_path: Stochastic depth of the backbone.
        batch_norm: Of the backbone, in training: ``fixed``, ``statistics fixed`` (its scales
            learn), ``learns``, or ``none``.
        frozen: First stages of the backbone that do not learn.
        synchronized: Whether batch norms that learn share statistics over GPUs.
        weights: File that the backbone starts from.
        left_out: Whether training leaves out samples without elements.
    """

    rates: dict[str, float] = field(
        default_factory=lambda: {"img_backbone": 6e-5, "the rest": 6e-4}
    )
    decay: float = 0.01
    clip: float | None = 35
    warm_up: tuple[int, float] | None = (500, 1 / 3)
    schedule: tuple[Any, ...] = ("CosineAnnealingLR", 1e-3)
    epochs: int = 24
    batch: int = 4
    evaluated: int = 2
    images: str = "distort scale"
    grid_mask: bool = True
    drop_path: float = 0.0
    batch_norm: str = "fixed"
    frozen: int = 1
    synchronized: bool = False
    weights: str = "resnet50-19c8e357.pth"
    left_out: bool = True


MAPTR = Settings()
FOUR_E4 = {"img_backbone": 4e-5, "the rest": 4e-4}
LINES = Settings(
    rates={"img_backbone": 5e-5, "the rest": 2e-4},
    clip=None,
    warm_up=None,
    schedule=("MultiStepLR", 21, 27, 0.2),
    epochs=30,
    batch=1,
    evaluated=5,  # the releases evaluate afterwards, by another command
    images="scale",
    grid_mask=False,
    batch_norm="statistics fixed",
    frozen=-1,
    synchronized=True,
    weights="resnet50-0676ba61.pth",
    left_out=False,
)
UPERNET = {
    "drop_path": 0.3,
    "batch_norm": "none",
    "frozen": -1,
    "weights": "upernet_swin_tiny_patch4_window7_512x512.pth",
}
EFFICIENT = {
    "drop_path": 0.2 * 15 / 16,  # of the last of 16 blocks
    "batch_norm": "learns",
    "frozen": -1,
    "weights": "efficientnet-b0-355c32eb.pth",
}


@cache
def released() -> dict[str, Settings]:
    """Settings of the releases by config, of each ``methods/<method>/released.py``."""
    found: dict[str, Settings] = {}
    for path in sorted(METHODS.glob("*/released.py")):
        module = importlib.import_module(f"methods.{path.parent.name}.released")
        found |= module.RELEASED
    return found


def rates_of(model: nn.Module, groups: list[dict], parts: tuple[str, ...]) -> dict[str, float]:
    """Return the learning rate of the parameters of each part, and of the rest.

    Args:
        model: The model.
        groups: Groups of its optimizer.
        parts: Beginnings of the names of parameters.

    Raises:
        AssertionError: If a part has several rates, or its parameters are in no group.
    """
    rate = {id(p): g.get("initial_lr", g["lr"]) for g in groups for p in g["params"]}
    found: dict[str, set[float]] = {}
    for name, parameter in model.named_parameters():
        if parameter.requires_grad:
            part = next((p for p in parts if name.startswith(f"{p}.")), "the rest")
            found.setdefault(part, set()).add(round(rate[id(parameter)], 12))
    assert all(len(rates) == 1 for rates in found.values()), found
    return {part: rates.pop() for part, rates in found.items()}


def batch_norm_of(backbone: nn.Module) -> str:
    """Return how the batch norms of a backbone that is trained behave, but in frozen stages."""
    norms = [m for m in backbone.modules() if isinstance(m, _BatchNorm)]
    if not norms:
        return "none"
    last = norms[-1]
    learns = last.weight is not None and last.weight.requires_grad
    if last.training:
        return "learns" if learns else "statistics learn"
    return "statistics fixed" if learns else "fixed"


def settings_of(cfg: Config, model: nn.Module, groups: list[dict]) -> Settings:
    """Return the settings of a config.

    Args:
        cfg: The config.
        model: Its model, in training.
        groups: Groups of its optimizer.
    """
    name = Path(cfg.filename).resolve().relative_to(REPO).as_posix()
    parts = tuple(part for part in released()[name].rates if part != "the rest")
    first, *others = cfg.param_scheduler
    warm_up = None
    if first.type == "LinearLR":
        assert not first.by_epoch
        warm_up = first.end, first.start_factor
    last = others[-1] if others else first
    numbers = [
        *last.get("milestones", ()),
        *(last[key] for key in ("eta_min_ratio", "step_size", "gamma") if key in last),
    ]
    data, backbone = cfg.train_dataloader, cfg.model.img_backbone
    return Settings(
        rates=rates_of(model, groups, parts),
        decay=cfg.optim_wrapper.optimizer.weight_decay,
        clip=(cfg.optim_wrapper.get("clip_grad") or {}).get("max_norm"),
        warm_up=warm_up,
        schedule=(last.type, *numbers),
        epochs=cfg.train_cfg.max_epochs,
        batch=data.batch_size,
        evaluated=cfg.train_cfg.val_interval,
        images=" ".join(
            IMAGE_STEPS[step.type] for step in data.dataset.pipeline if step.type in IMAGE_STEPS
        ),
        grid_mask=(cfg.model.get("img_augment") or {}).get("type") == "GridMask",
        drop_path=backbone.get("drop_path_rate", 0.0),
        batch_norm=batch_norm_of(model.img_backbone),
        frozen=backbone.get("frozen_stages", -1),
        synchronized=cfg.get("sync_bn") == "torch",
        weights=Path(backbone.init_cfg.checkpoint).name,
        left_out=data.dataset.get("filter_empty_gt", True),
    )
