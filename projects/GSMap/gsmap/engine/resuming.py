"""Checks that a training can be resumed from a checkpoint."""

import io
import math
import pickle
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import chain
from typing import Any

import torch
from mmengine.logging import HistoryBuffer
from mmengine.optim import OptimWrapper, _ParamScheduler
from mmengine.runner import EpochBasedTrainLoop, Runner
from torch import Tensor
from torch.optim import Optimizer

from gsmap.checkpoints.safe_globals import mmengine_globals
from gsmap.checkpoints.settings import plain
from gsmap.utils.errors import InputError

_PARTS = ("meta", "message_hub", "optimizer")  # parts of a checkpoint that mmengine resumes from
# Parts of the state of the message hub, in which mmengine stores logged values and the progress.
_HUB_KEYS = ("log_scalars", "runtime_info", "resumed_keys")
# Parts of a checkpoint to which data sets, hooks and schedules of a user add entries
_OPEN_PARTS = ("meta", "message_hub", "param_schedulers")
_SEED_COUNT = 2**32  # seeds that numpy accepts
# Entries of the state of a schedule that are no settings: its progress and its values so far.
_SCHEDULE_PROGRESS = {"last_step", "_global_step", "_last_value", "base_values", "verbose"}


def refusal(path: object, reason: str) -> ValueError:
    """Return an error with the reason why a checkpoint cannot be resumed from, and a remedy."""
    return InputError(
        f"{path} cannot be resumed from: {reason}. --resume takes a checkpoint that a training "
        f"with this config wrote; to start from its weights alone give --cfg-options "
        f"load_from={path}."
    )


@contextmanager
def refusing_state(path: object) -> Iterator[None]:
    """Context manager that replaces the exceptions of a malformed state by a one-line error.

    Args:
        path: File of the checkpoint, for the error.

    Raises:
        ValueError: If loading the state raises an exception that a malformed state can cause.
    """
    try:
        yield
    except (LookupError, TypeError, AttributeError, AssertionError) as error:
        reason = f"its state does not fit ({type(error).__name__}: {error})"
        raise refusal(path, reason=reason) from error


def drop_functions(checkpoint: dict[str, Any]) -> None:
    """Remove functions from the states of the schedulers of a checkpoint, in place.

    Loading refuses a function in a file. A resumed scheduler has its functions from the config.
    """
    schedules = checkpoint.get("param_schedulers", [])
    # A training with several optimizers has a list for each of them, by name.
    for states in schedules.values() if isinstance(schedules, dict) else [schedules]:
        for index, state in enumerate(states):
            states[index] = {name: value for name, value in state.items() if not callable(value)}


def check_readable(checkpoint: Mapping[str, Any]) -> None:
    """Require that the parts with entries of a user can be read without running code from a file.

    Raises:
        ValueError: If a part has an entry that `torch.load` would refuse with ``weights_only``.
    """
    for part in _OPEN_PARTS:
        value = checkpoint.get(part)
        if _is_readable(value=value):
            continue
        name, entry = _find_unreadable(value=value, name=part)
        raise InputError(
            f"{name} of the checkpoint is a {type(entry).__name__}, with which the checkpoint "
            "could not be loaded: let what sets it, such as a hook or a data set, store numbers, "
            "texts, tensors, or lists and dictionaries of them."
        )


def _is_readable(value: Any) -> bool:
    """Whether a value can be saved, and loaded again without running code."""
    file = io.BytesIO()
    try:
        torch.save(value, file)
        file.seek(0)
        with torch.serialization.safe_globals(mmengine_globals()):
            torch.load(file, weights_only=True)
    except (pickle.PickleError, AttributeError, TypeError):
        return False
    return True


def _find_unreadable(value: Any, name: str) -> tuple[str, Any]:
    """Return the innermost entry of an unreadable value that is unreadable, after its dotted name.

    Args:
        value: Value that `_is_readable` refuses.
        name: Dotted name of the value.
    """
    entries = dict(enumerate(value)) if isinstance(value, list | tuple) else value
    if isinstance(entries, Mapping):
        for key, entry in entries.items():
            if not _is_readable(value=entry):
                return _find_unreadable(value=entry, name=f"{name}.{key}")
    return name, value


def check_resumable(checkpoint: Mapping[str, Any], runner: Runner, path: object) -> None:
    """Require a checkpoint from which mmengine can resume without errors and with a valid state.

    Args:
        checkpoint: Content of the checkpoint.
        runner: Runner whose training loop is built.
        path: File of the checkpoint, for the error.

    Raises:
        ValueError: If a part is missing or malformed, or if the checkpoint is from a later epoch or
            iteration than the end of this training.
    """
    missing = [part for part in _PARTS if not isinstance(checkpoint.get(part), Mapping)]
    if missing:
        reason = f"it holds weights and no {' and no '.join(missing)}"
    else:
        schedules = checkpoint.get("param_schedulers")
        reason = (
            _progress_fault(checkpoint["meta"], runner=runner)
            or _hub_fault(checkpoint["message_hub"])
            or _optimizer_fault(checkpoint["optimizer"])
            or _schedule_fault(schedules, runner=runner)
        )
    if reason:
        raise refusal(path, reason=reason)


def check_optimizer_state(state: Mapping[str, Any], optimizer: Optimizer, path: object) -> None:
    """Require plausible values in an optimizer state, which torch loads without checks.

    Args:
        state: State from the checkpoint. ``param_groups`` has the settings and the parameters of
            each group; ``state`` has the entries of each parameter, such as its moments.
        optimizer: Optimizer of the run.
        path: File of the checkpoint, for the error.

    Raises:
        ValueError: If the run trains another number of weights, if a setting has another type than
            in the run, or if an entry is not finite, or has neither a single value nor the shape of
            its parameter.
    """
    # `zip` is not strict: torch itself refuses a state with another number of groups.
    for group, run_group in zip(state["param_groups"], optimizer.param_groups, strict=False):
        # ``params`` has the numbers of the parameters. The other keys are settings.
        for name in run_group.keys() & (group.keys() - {"params"}):
            if not _is_compatible(group[name], reference=run_group[name]):
                raise refusal(path, reason=f"its optimizer has {name} = {group[name]!r:.40}")
    # The state refers to parameters by number, in the order of the groups.
    numbers = list(chain.from_iterable(group["params"] for group in state["param_groups"]))
    parameters = list(chain.from_iterable(group["params"] for group in optimizer.param_groups))
    has_equal_groups = len(state["param_groups"]) == len(optimizer.param_groups)
    if has_equal_groups and len(numbers) != len(parameters):
        reason = (
            f"its optimizer has {len(numbers)} weights, and this run trains {len(parameters)} "
            "(other parts may be frozen)"
        )
        raise refusal(path, reason=reason)
    for number, parameter in zip(numbers, parameters, strict=False):
        entries = state["state"].get(number, {})
        if not isinstance(entries, Mapping):
            raise refusal(path, reason=f"its optimizer has the state {entries!r:.40}")
        for name, value in entries.items():
            if not _fits(value, parameter=parameter):
                reason = f"its optimizer has a {name!r:.40} that does not fit its parameter"
                raise refusal(path, reason=reason)


def fit_schedules(checkpoint: Mapping[str, Any], configs: Any, ratio: float) -> None:
    """Convert schedules of a checkpoint to epochs of another length, in place.

    A schedule over epochs with ``convert_to_iter_based`` counts iterations in its state. Its
    progress is converted, and its settings are removed, so that those of the run count. Other
    schedules are not changed. They count epochs, or iterations that the config gives.

    Args:
        checkpoint: Content of the checkpoint.
        configs: Schedules in the config of the run, in the order of those of the checkpoint; a
            single one may stand without a list.
        ratio: Length of an epoch in the run, relative to that in the checkpoint.
    """
    states = checkpoint.get("param_schedulers")
    if isinstance(configs, Mapping):
        configs = [configs]
    if not isinstance(states, list) or not isinstance(configs, list) or len(states) != len(configs):
        return
    for state, config in zip(states, configs, strict=True):
        if not config.get("convert_to_iter_based") or not isinstance(state, dict):
            continue
        for name in list(state):
            if name not in _SCHEDULE_PROGRESS:
                del state[name]
        for name in ("last_step", "_global_step"):
            if type(state.get(name)) is int:
                state[name] = round(state[name] * ratio)


def ignored_settings(checkpoint: Mapping[str, Any], runner: Runner) -> list[str]:
    """Settings of the optimizer and the schedules of a run that a checkpoint replaces.

    mmengine restores both with their settings, so a changed setting of the config has no effect.

    Args:
        checkpoint: Content of the checkpoint, which has passed the checks of this module.
        runner: Runner of the run.

    Returns:
        A text with both values for each setting. Several optimizers are not compared.
    """
    texts = []
    if isinstance(runner.optim_wrapper, OptimWrapper):
        groups = runner.optim_wrapper.param_groups
        for saved, group in zip(checkpoint["optimizer"]["param_groups"], groups, strict=False):
            for name in group:
                # With a schedule, the rate of the config is ``initial_lr``, and ``lr`` changes.
                is_setting = name in saved and name != "params" and f"initial_{name}" not in group
                if is_setting and plain(saved[name]) != plain(group[name]):
                    setting = name.removeprefix("initial_")
                    texts.append(f"{setting} {saved[name]} (config: {group[name]})")
    if isinstance(runner.param_schedulers, list):
        states = checkpoint.get("param_schedulers") or []
        for saved, schedule in zip(states, runner.param_schedulers, strict=False):
            for name, value in schedule.state_dict().items():
                is_setting = name not in _SCHEDULE_PROGRESS and not callable(value)
                if is_setting and saved.get(name, value) != value:
                    kind = type(schedule).__name__
                    texts.append(f"{kind}.{name} {saved.get(name)} (config: {value})")
    return list(dict.fromkeys(texts))  # without repetitions: groups often differ alike


def _fits(value: Any, parameter: Tensor) -> bool:
    """Whether a value is a plausible entry of an optimizer's state for a parameter."""
    if isinstance(value, Tensor):
        has_valid_shape = value.shape in ((), parameter.shape)  # () for a count of steps
        return has_valid_shape and bool(value.isfinite().all())
    return value is None or _is_number(value)


def _is_number(value: Any) -> bool:
    """Whether a value is a finite number or a flag."""
    return isinstance(value, int | float) and math.isfinite(value)


def _is_compatible(value: Any, reference: Any) -> bool:
    """Whether a value can replace a reference value of an optimizer.

    A finite number can replace a number. A list can replace a list of equal length if each entry
    can replace the reference's entry at its position. None, a text, a number or a tensor can
    replace None. All other values must have the type of the reference.
    """
    if isinstance(reference, list | tuple):
        if not isinstance(value, list | tuple) or len(value) != len(reference):
            return False
        return all(map(_is_compatible, value, reference))
    if isinstance(reference, int | float):
        return _is_number(value)
    if reference is None:
        return value is None or isinstance(value, str | int | float | Tensor)
    return isinstance(value, type(reference))


def _progress_fault(meta: Mapping[str, Any], runner: Runner) -> str:
    """Return the fault of the epoch, the iteration or the seed; empty if there is none."""
    loop = runner.train_loop
    if isinstance(loop, EpochBasedTrainLoop):
        limits = {"epoch": loop.max_epochs, "iter": None}  # None: not limited
    else:
        limits = {"epoch": None, "iter": loop.max_iters}
    for name, limit in limits.items():
        value = meta.get(name)
        # `isinstance` would accept a bool. Counts are 64-bit integers.
        if type(value) is not int or not 0 <= value < 2**63:
            return f"its {name} is {value!r:.40}"
        if limit is not None and value > limit:
            return f"its {name} is {value}, and train_cfg.max_{name}s is {limit}"
    seed = meta.get("seed")
    if seed is not None and not (type(seed) is int and 0 <= seed < _SEED_COUNT):
        return f"its seed is {seed!r:.40}"
    return ""


def _hub_fault(hub: Mapping[str, Any]) -> str:
    """Return the fault of the state of the message hub; empty if there is none."""
    for key in _HUB_KEYS:
        if not isinstance(hub.get(key), Mapping):
            return f"its message_hub has no {key}"
    for name, history in hub["log_scalars"].items():
        if not isinstance(history, HistoryBuffer):
            return f"its message_hub has {name!r:.40} without a history"
    return ""


def _optimizer_fault(optimizer: Mapping[str, Any]) -> str:
    """Return the fault of the state of the optimizer; empty if there is none."""
    fault = "its optimizer has no state and param_groups"
    groups = optimizer.get("param_groups")
    if not isinstance(optimizer.get("state"), Mapping) or not isinstance(groups, list):
        return fault
    for group in groups:
        if not isinstance(group, Mapping) or "params" not in group:
            return fault
    return ""


def _schedule_fault(states: Any, runner: Runner) -> str:
    """Return the fault of the states of the schedulers; empty if there is none.

    mmengine sets each entry of a state as an attribute of its scheduler, so an entry must not
    replace a method.
    """
    schedules = runner.param_schedulers
    # mmengine has a dict of schedulers in place of a list if a training has several optimizers.
    # Their states are not checked.
    if states is None or not isinstance(schedules, list):
        return ""
    if not isinstance(states, list) or not all(isinstance(state, Mapping) for state in states):
        return "its param_schedulers are no list of states"
    if len(states) != len(schedules):
        return f"it has {len(states)} schedules, and the config {len(schedules)}"
    for state in states:
        for key in state:
            if hasattr(_ParamScheduler, str(key)):
                return f"a schedule has a state {key!r:.40}"
    for state, schedule in zip(states, schedules, strict=True):
        run_state = schedule.state_dict()
        for name in run_state.keys() & state.keys():
            if not _is_compatible(state[name], reference=run_state[name]):
                return f"a schedule has {name} = {state[name]!r:.40}"
    return ""
