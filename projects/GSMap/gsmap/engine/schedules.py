"""Check that schedules, such as those of the learning rate, fit the length of a training."""

from collections.abc import Mapping
from typing import Any

from mmengine.config import Config, ConfigDict

from gsmap.utils.errors import InputError

_WARM_UPS = ("Constant", "Linear")  # names of schedules that may end after a short training
NEVER = 1_000_000_000
"""End that mmengine takes for a schedule without an end."""


def check_schedules(cfg: Config, iterations: int | None = None) -> None:
    """Require that the schedules of a config fit the length of its training.

    A schedule starts after ``begin`` epochs or iterations, and counts from there. A cosine schedule
    (``T_max``, ``total_steps`` or ``periods``) must last until its own end or that of the training,
    and ``milestones`` must lie before. A schedule other than a warm-up must not end after the
    training. If the training counts iterations, schedules must, too.

    Args:
        cfg: Config of a training.
        iterations: Number of iterations of the training; None if only ``train_cfg`` gives it.

    Raises:
        ValueError: If a schedule does not fit; the message names the setting.
    """
    train_cfg = cfg.get("train_cfg") or {}
    epochs = train_cfg.get("max_epochs")
    counts_iterations = train_cfg.get("max_iters") is not None
    if iterations is None:
        iterations = train_cfg.get("max_iters")
    for name, scheduler in find_schedulers(cfg).items():
        if not scheduler.get("by_epoch", True):
            if iterations is not None:
                _check_length(cfg, name, scheduler, training=iterations, unit="iterations")
        elif epochs is not None:
            _check_length(cfg, name, scheduler, training=epochs, unit="epochs")
        elif _kind(scheduler).startswith("ReduceOnPlateau"):
            continue  # it changes values after a validation
        elif counts_iterations and not scheduler.get("convert_to_iter_based"):
            raise InputError(
                f"{cfg.filename}: training counts iterations, but {name} counts epochs and would "
                f"never change a value: set {name}.by_epoch=False, and its numbers to iterations."
            )


def _check_length(
    cfg: Config, name: str, scheduler: Mapping[str, Any], training: int, unit: str
) -> None:
    """Require that one schedule fits the length of the training.

    Args:
        cfg: Config of a training.
        name: Dotted name of the schedule.
        scheduler: Its settings.
        training: Length of the training.
        unit: Unit of all lengths, ``"epochs"`` or ``"iterations"``.
    """
    setting = "train_cfg.max_epochs" if unit == "epochs" else "the length of the training"
    begin, end = _range_of(cfg, name, scheduler, training=training, unit=unit)
    key, length = _own_length(scheduler)
    if length is not None and length != end - begin:
        start = f" and begins after {begin}" if begin else ""
        own = f" and ends after {end}" if end < training else ""
        raise InputError(
            f"{cfg.filename}: training lasts {training} {unit} but the cosine schedule {length}"
            f"{start}{own}: set both {setting} and {name}.{key}, or inherit from a base file that "
            "sets both."
        )
    last = max(find_milestones(scheduler), default=0)
    if last and last >= end - begin:
        raise InputError(
            f"{cfg.filename}: training lasts {training} {unit} but the last milestone of the "
            f"schedule comes after {begin + last}: set {name}.milestones to numbers below "
            f"{end - begin}, or a larger number for {setting}."
        )


def _range_of(
    cfg: Config, name: str, scheduler: Mapping[str, Any], training: int, unit: str
) -> tuple[float, float]:
    """Begin and end of a schedule, within the training.

    Args:
        cfg: Config of a training.
        name: Dotted name of the schedule.
        scheduler: Its settings.
        training: Length of the training.
        unit: Unit of all lengths.

    Raises:
        ValueError: If the schedule never begins, or ends after the training and is no warm-up.
    """
    begin = scheduler.get("begin", 0)
    end = scheduler.get("end", training)
    if not isinstance(begin, int | float) or not isinstance(end, int | float):
        raise InputError(
            f"{cfg.filename}: {name}.begin and .end must be numbers of {unit}, got {begin!r:.40} "
            f"and {end!r:.40}."
        )
    if end >= NEVER:
        end = training
    if begin >= training or (end > training and not _kind(scheduler).startswith(_WARM_UPS)):
        raise InputError(
            f"{cfg.filename}: training lasts {training} {unit} but {name} begins after {begin} and "
            f"ends after {end}: set {name}.begin and .end to numbers up to {training}, or a larger "
            "number for the length of the training."
        )
    return begin, min(end, training)


def _own_length(scheduler: Mapping[str, Any]) -> tuple[str, float | None]:
    """Setting with the length of a cosine schedule of any kind, and its value; None without one."""
    for key in ("T_max", "total_steps"):
        if isinstance(scheduler.get(key), int | float):
            return key, scheduler[key]
    periods = scheduler.get("periods")
    if isinstance(periods, list | tuple) and all(isinstance(x, int | float) for x in periods):
        return "periods", sum(periods)
    return "", None


def _kind(scheduler: Mapping[str, Any]) -> str:
    """Name of the class of a scheduler, without the scope of a registry; empty if unknown."""
    kind = scheduler.get("type", "")
    return str(getattr(kind, "__name__", kind)).rpartition(".")[-1]


def find_milestones(scheduler: Mapping[str, Any]) -> list[float]:
    """Return the milestones of a scheduler, empty if it has none.

    Values of a wrong type are left out, because the scheduler reports them when it is built.
    """
    milestones = scheduler.get("milestones")
    if not isinstance(milestones, list | tuple):
        return []
    return [milestone for milestone in milestones if isinstance(milestone, int | float)]


def find_schedulers(cfg: Config) -> dict[str, ConfigDict]:
    """Find the schedulers of a config.

    A config has one scheduler, a list of them, or one of both for each of several optimizers.

    Returns:
        Settings of each scheduler, by dotted name.
    """
    settings = cfg.get("param_scheduler") or []
    groups = {"param_scheduler": settings}
    if isinstance(settings, dict) and all(isinstance(v, dict | list) for v in settings.values()):
        groups = {f"param_scheduler.{name}": group for name, group in settings.items()}
    schedulers: dict[str, ConfigDict] = {}
    for name, group in groups.items():
        if isinstance(group, dict):
            schedulers[name] = group
            continue
        for index, scheduler in enumerate(group):
            schedulers[f"{name}.{index}"] = scheduler
    return schedulers
