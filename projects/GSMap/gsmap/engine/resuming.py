"""What a checkpoint must hold so that a training can go on from it."""

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import chain
from typing import Any

from mmengine.logging import HistoryBuffer
from mmengine.optim import _ParamScheduler
from mmengine.runner import EpochBasedTrainLoop, Runner
from torch import Tensor
from torch.optim import Optimizer

from gsmap.utils.errors import InputError

_PARTS = ("meta", "message_hub", "optimizer")
_HUB = ("log_scalars", "runtime_info", "resumed_keys")
_SEEDS = 2**32


def refusal(path: object, reason: str) -> ValueError:
    """Return the error that says why a checkpoint cannot be resumed from, and what to do."""
    return InputError(
        f"{path} cannot be resumed from: {reason}. --resume takes a checkpoint that a training "
        f"with this config wrote; to start from its weights alone give --cfg-options "
        f"load_from={path}."
    )


@contextmanager
def refusing_state(path: object) -> Iterator[None]:
    """Say in a line which checkpoint's state does not fit."""
    try:
        yield
    except (LookupError, TypeError, AttributeError, AssertionError) as error:
        reason = f"its state does not fit ({type(error).__name__}: {error})"
        raise refusal(path, reason) from error


def check_resumable(checkpoint: Mapping[str, Any], runner: Runner, path: object) -> None:
    """Refuse a checkpoint that mmengine cannot go on from, or would go on from wrongly.

    Args:
        checkpoint: What was read of it.
        runner: The run, whose loop is built.
        path: Its file, for the error.

    Raises:
        ValueError: If a part is missing or odd, or the training is longer than the config's.
    """
    missing = [part for part in _PARTS if not isinstance(checkpoint.get(part), Mapping)]
    reason = (
        f"it holds weights and no {' and no '.join(missing)}"
        if missing
        else _odd_progress(checkpoint["meta"], runner)
        or _odd_hub(checkpoint["message_hub"])
        or _odd_optimizer(checkpoint["optimizer"])
        or _odd_schedules(checkpoint.get("param_schedulers"), runner)
    )
    if reason:
        raise refusal(path, reason)


def check_optimizer_state(state: Mapping[str, Any], optimizer: Optimizer, path: object) -> None:
    """Refuse a state of an optimizer whose values torch would take as they are.

    Args:
        state: State from the checkpoint, with the groups of parameters of the optimizer.
        optimizer: The optimizer of the run.
        path: File of the checkpoint, for the error.

    Raises:
        ValueError: If a setting has another type, or an entry is not finite, or has neither one
            value nor the shape of its parameter.
    """
    for group, own in zip(state["param_groups"], optimizer.param_groups, strict=False):
        for name in own.keys() & group.keys() - {"params"}:
            if not _is_alike(group[name], own[name]):
                raise refusal(path, f"its optimizer has {name} = {group[name]!r:.40}")
    numbers = chain.from_iterable(group["params"] for group in state["param_groups"])
    parameters = chain.from_iterable(group["params"] for group in optimizer.param_groups)
    for number, parameter in zip(numbers, parameters, strict=False):
        entries = state["state"].get(number, {})
        if not isinstance(entries, Mapping):
            raise refusal(path, f"its optimizer has the state {entries!r:.40}")
        for name, value in entries.items():
            if not _fits(value, parameter):
                reason = f"its optimizer has a {name!r:.40} that does not fit its parameter"
                raise refusal(path, reason)


def _fits(value: Any, parameter: Tensor) -> bool:
    """Whether an entry of an optimizer's state can be one of a parameter."""
    if isinstance(value, Tensor):
        return value.shape in ((), parameter.shape) and bool(value.isfinite().all())
    return value is None or _is_number(value)


def _is_number(value: Any) -> bool:
    """Whether a value is a finite number or a flag."""
    return isinstance(value, int | float) and math.isfinite(value)


def _is_alike(value: Any, own: Any) -> bool:
    """Whether a value can take the place of another: numbers are finite, lists as long."""
    if isinstance(own, list | tuple):
        same_length = isinstance(value, list | tuple) and len(value) == len(own)
        return same_length and all(map(_is_alike, value, own))
    if isinstance(own, int | float) and value is not None:
        return _is_number(value)
    plain = value is None or isinstance(value, str | int | float | Tensor)
    return plain if own is None else isinstance(value, type(own))


def _odd_progress(meta: Mapping[str, Any], runner: Runner) -> str:
    """Say what is wrong with the epoch, the iteration or the seed."""
    loop = runner.train_loop
    limits = {"epoch": loop.max_epochs, "iter": None}
    if not isinstance(loop, EpochBasedTrainLoop):
        limits = {"epoch": None, "iter": loop.max_iters}
    for name, limit in limits.items():
        value = meta.get(name)
        if type(value) is not int or not 0 <= value < 2**63:
            return f"its {name} is {value!r:.40}"
        if limit is not None and value > limit:
            return f"its {name} is {value}, and train_cfg.max_{name}s is {limit}"
    seed = meta.get("seed")
    if seed is not None and not (type(seed) is int and 0 <= seed < _SEEDS):
        return f"its seed is {seed!r:.40}"
    return ""


def _odd_hub(hub: Mapping[str, Any]) -> str:
    """Say what is wrong with the figures of the log."""
    odd = [name for name in _HUB if not isinstance(hub.get(name), Mapping)]
    if odd:
        return f"its message_hub has no {odd[0]}"
    for name, figures in hub["log_scalars"].items():
        if not isinstance(figures, HistoryBuffer):
            return f"its message_hub has {name!r:.40} without a history"
    return ""


def _odd_optimizer(optimizer: Mapping[str, Any]) -> str:
    """Say what is wrong with the state of the optimizer."""
    groups = optimizer.get("param_groups")
    whole = isinstance(optimizer.get("state"), Mapping) and isinstance(groups, list)
    if not whole or not all(isinstance(g, Mapping) and "params" in g for g in groups or ()):
        return "its optimizer has no state and param_groups"
    return ""


def _odd_schedules(states: Any, runner: Runner) -> str:
    """Say what is wrong with the states of the schedules, which mmengine takes as attributes."""
    schedules = runner.param_schedulers
    if states is None or not isinstance(schedules, list):
        return ""
    if not isinstance(states, list) or not all(isinstance(state, Mapping) for state in states):
        return "its param_schedulers are no list of states"
    if len(states) != len(schedules):
        return f"it has {len(states)} schedules, and the config {len(schedules)}"
    foreign = [key for state in states for key in state if hasattr(_ParamScheduler, str(key))]
    if foreign:
        return f"a schedule has a state {foreign[0]!r:.40}"
    for state, schedule in zip(states, schedules, strict=True):
        own = schedule.state_dict()
        for name in own.keys() & state.keys():
            if not _is_alike(state[name], own[name]):
                return f"a schedule has {name} = {state[name]!r:.40}"
    return ""
