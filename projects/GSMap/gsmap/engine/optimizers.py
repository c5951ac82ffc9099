"""Optimizers of few parameter groups, which read nothing from a GPU."""

import inspect
from collections.abc import Sequence
from operator import itemgetter
from typing import Any

from mmengine.optim import AmpOptimWrapper, DefaultOptimWrapperConstructor, OptimWrapper
from mmengine.registry import OPTIM_WRAPPER_CONSTRUCTORS, OPTIM_WRAPPERS, OPTIMIZERS
from torch import Tensor, nn

from gsmap.engine.figures import keep_figures
from gsmap.utils.errors import InputError

_KERNELS = ("fused", "foreach")  # settings of a group that say how a step is computed
_LISTS = ("base_values", "_last_value")  # of a scheduler's state, one value a group


class _LateNorm(OptimWrapper):
    """Keeps the norm of the gradients on their device until it is logged.

    Attributes:
        members: Places of each group's parameters in the model; empty with one group of all.
    """

    members: Sequence[Sequence[int]] = ()

    def _clip_grad(self) -> None:
        params = [p for group in self.optimizer.param_groups for p in group["params"]]
        places = [place for group in self.members for place in group]
        if places:  # in the model's order, in which the norms are summed
            params = [
                param for _, param in sorted(zip(places, params, strict=True), key=itemgetter(0))
            ]
        params = [p for p in params if p.requires_grad and p.grad is not None]
        if params:
            norm = self.clip_func(params, **self.clip_grad_kwargs)
            if norm is not None:  # clipped by value
                keep_figures(self.message_hub, {f"train/{self.grad_name}": norm})


@OPTIM_WRAPPERS.register_module()
class MapOptimWrapper(_LateNorm):
    """mmengine's `OptimWrapper`, which waits for nothing on a GPU.

    There a loss that is not finite is found out one step later (`LossCheck`). A fused optimizer
    leaves the weights as they are until then.
    """

    _unfit: Tensor | None = None  # whether a loss since the last step is not finite

    def update_params(self, loss: Tensor, *args: Any, **kwargs: Any) -> None:
        """Compute gradients and, unless they are accumulated further, take a step."""
        if loss.device.type != "cpu":
            unfit = loss.detach().isfinite().logical_not().float()
            self._unfit = unfit if self._unfit is None else self._unfit.maximum(unfit)
        super().update_params(loss, *args, **kwargs)

    def step(self, **kwargs: Any) -> None:
        """Clip the gradients and take a step."""
        skipping = getattr(self.optimizer, "_step_supports_amp_scaling", False)
        if skipping and self._unfit is not None:
            self.optimizer.found_inf = self._unfit
        super().step(**kwargs)
        self._unfit = None
        self.optimizer.__dict__.pop("found_inf", None)


@OPTIM_WRAPPERS.register_module()
class MapAmpOptimWrapper(_LateNorm, AmpOptimWrapper):
    """mmengine's `AmpOptimWrapper`, which reads the norm of the gradients when it is logged."""


@OPTIM_WRAPPER_CONSTRUCTORS.register_module()
class MergedGroupsConstructor(DefaultOptimWrapperConstructor):
    """mmengine's constructor, with one group for all parameters of equal settings.

    mmengine makes a group of each parameter with ``paramwise_cfg``, and a GPU then takes hundreds
    of steps, each of one parameter. ``fused_on_gpu=False`` in ``optim_wrapper`` keeps a step on a
    GPU from being computed by one kernel; ``optimizer.fused`` has the last word.
    """

    def __init__(self, optim_wrapper_cfg: dict, paramwise_cfg: dict | None = None) -> None:
        super().__init__(optim_wrapper_cfg, paramwise_cfg)
        self.fused_on_gpu = self.optim_wrapper_cfg.pop("fused_on_gpu", True)
        self._members: list[list[int]] = []

    def add_params(
        self, params: list[dict], module: nn.Module, prefix: str = "", is_dcn_module: Any = None
    ) -> None:
        """Add the groups of a module's parameters; those of the whole model are merged."""
        super().add_params(params, module, prefix, is_dcn_module)
        if prefix:
            return
        kinds: dict[str, list[int]] = {}
        for number, group in enumerate(params):
            settings = sorted((key, value) for key, value in group.items() if key != "params")
            kinds.setdefault(repr(settings), []).append(number)
        self._members = list(kinds.values())
        merged = []
        for numbers in self._members:
            together = [param for number in numbers for param in params[number]["params"]]
            merged.append({**params[numbers[0]], "params": together})
        params[:] = merged

    def __call__(self, model: nn.Module) -> OptimWrapper:
        """Build the optimizer of a model, and what wraps it."""
        kind = self.optimizer_cfg["type"]
        kind = OPTIMIZERS.get(kind) if isinstance(kind, str) else kind
        takes = set(inspect.signature(kind).parameters)
        on_gpu = all(param.device.type != "cpu" for param in model.parameters())
        if self.fused_on_gpu and on_gpu and set(_KERNELS) <= takes - set(self.optimizer_cfg):
            self.optimizer_cfg["fused"] = True
        wrapper = super().__call__(model)
        wrapper.members = self._members
        return wrapper


def fit_optimizer_state(checkpoint: dict[str, Any], wrapper: Any) -> None:
    """Fit a checkpoint's optimizer and schedulers, in place, to an optimizer of merged groups.

    A checkpoint may have a group of each parameter, as mmengine's constructor makes them; and it
    may have been computed on another kind of device.

    Args:
        checkpoint: A training's checkpoint, perhaps without an optimizer.
        wrapper: What wraps the optimizer that is to go on, from `MergedGroupsConstructor`.

    Raises:
        ValueError: If parameters of one group had different settings.
    """
    state = checkpoint.get("optimizer")
    members: list[list[int]] | None = getattr(wrapper, "members", None)
    if members is None or not isinstance(state, dict) or "param_groups" not in state:
        return
    numbers = [number for group in members for number in group]
    groups = state["param_groups"]
    if len(groups) > len(members) and [len(g["params"]) for g in groups] == [1] * len(numbers):
        state["param_groups"] = _merged(groups, members)
        old = state["state"]
        state["state"] = {new: old[number] for new, number in enumerate(numbers) if number in old}
        kept = len(wrapper.param_groups) - len(members)  # mmengine's base settings
        if not kept:
            state.pop("base_param_settings", None)
        for scheduler in _schedulers(checkpoint.get("param_schedulers")):
            for name in set(_LISTS) & set(scheduler):
                values = scheduler[name]
                firsts = [values[group[0]] for group in members]
                scheduler[name] = firsts + values[len(numbers) : len(numbers) + kept]
    for group, own in zip(state["param_groups"], wrapper.optimizer.param_groups, strict=False):
        group.update({name: own[name] for name in _KERNELS if name in own and name in group})


def _merged(groups: Sequence[dict], members: Sequence[Sequence[int]]) -> list[dict]:
    """Return groups of several parameters from groups of one; all of one must be set alike."""
    merged = []
    first = 0
    for numbers in members:
        settings = [{k: v for k, v in groups[n].items() if k != "params"} for n in numbers]
        if any(each != settings[0] for each in settings):
            raise InputError(
                "the checkpoint's parameter groups differ in settings that are equal in the "
                "config: resume with the config that it was trained with, or start anew from it "
                "(load_from=...)."
            )
        merged.append({**settings[0], "params": list(range(first, first + len(numbers)))})
        first += len(numbers)
    return merged


def _schedulers(states: Any) -> list[dict]:
    """Return the states of schedulers, of one list or of one by parameter."""
    if isinstance(states, dict):
        return [state for each in states.values() for state in each]
    return list(states or ())
