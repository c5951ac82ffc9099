"""Optimizer wrappers with few parameter groups and without GPU synchronisation."""

import inspect
from collections.abc import Sequence
from operator import itemgetter
from typing import Any

from mmengine.dist import all_reduce
from mmengine.optim import AmpOptimWrapper, DefaultOptimWrapperConstructor, OptimWrapper
from mmengine.registry import OPTIM_WRAPPER_CONSTRUCTORS, OPTIM_WRAPPERS, OPTIMIZERS
from torch import Tensor, nn

from gsmap.engine.figures import keep_figures
from gsmap.utils.errors import InputError

# Settings of an optimizer, in each parameter group, that choose the GPU kernels of a step.
_KERNELS = ("fused", "foreach")
# Entries of the state of mmengine's schedulers that are lists with one value per group.
_SCHEDULER_LISTS = ("base_values", "_last_value")


class _LateNorm(OptimWrapper):
    """Optimizer wrapper that keeps the gradient norm on its device until it is logged.

    Attributes:
        members: For each group, the positions of its parameters in the order of the model. It is
            empty if `MergedGroupsConstructor` has not merged the groups.
    """

    members: Sequence[Sequence[int]] = ()

    def _clip_grad(self) -> None:
        """Clip the gradients. The overridden method of mmengine would wait for the norm."""
        params: list[Tensor] = []
        # Sum the norms in the order of the model, so that rounding does not depend on groups.
        for param in self._params_in_model_order():
            if param.requires_grad and param.grad is not None:
                params.append(param)
        if not params:
            return
        norm = self.clip_func(params, **self.clip_grad_kwargs)
        if norm is not None:  # clipping by value has no norm
            # `keep_figures` adds the norm to the log; a value on a GPU is copied only when the log
            # is read.
            keep_figures(self.message_hub, figures={f"train/{self.grad_name}": norm})

    def _params_in_model_order(self) -> list[Tensor]:
        """Parameters of all groups; in the order of the groups if they are not merged."""
        params: list[Tensor] = []
        for group in self.optimizer.param_groups:
            params.extend(group["params"])
        model_indices: list[int] = []
        for indices in self.members:
            model_indices.extend(indices)
        if not model_indices:
            return params
        indexed_params = sorted(zip(model_indices, params, strict=True), key=itemgetter(0))
        return [param for _, param in indexed_params]


@OPTIM_WRAPPERS.register_module()
class MapOptimWrapper(_LateNorm):
    """mmengine's `OptimWrapper` without GPU synchronisation.

    On a GPU, the model detects a loss that is not finite only one step later (`LossCheck`). Until
    then a fused optimizer skips its steps, on all ranks if the loss of one is not finite, so the
    weights stay unchanged. On a CPU, the model raises the error in the step of the loss.
    """

    # On a GPU, 1.0 if a loss since the last step is not finite, and 0.0 otherwise. There are
    # several losses if gradients are accumulated.
    _has_nonfinite_loss: Tensor | None = None

    def update_params(
        self, loss: Tensor, step_kwargs: dict | None = None, zero_kwargs: dict | None = None
    ) -> None:
        """Compute gradients and take a step once enough of them are accumulated.

        Args:
            loss: Loss of the iteration. ()
            step_kwargs: Arguments of the optimizer's ``step``.
            zero_kwargs: Arguments of the optimizer's ``zero_grad``.
        """
        if loss.device.type != "cpu":
            is_nonfinite = loss.detach().isfinite().logical_not().float()
            if self._has_nonfinite_loss is None:
                self._has_nonfinite_loss = is_nonfinite
            else:
                self._has_nonfinite_loss = self._has_nonfinite_loss.maximum(is_nonfinite)
        super().update_params(loss, step_kwargs=step_kwargs, zero_kwargs=zero_kwargs)

    def step(self, **kwargs: Any) -> None:
        """Clip the gradients and take a step."""
        # A fused optimizer of torch skips a step if its attribute `found_inf` is 1. Torch made this
        # attribute for its gradient scaler, hence the name of the flag that shows the support.
        can_skip_steps = getattr(self.optimizer, "_step_supports_amp_scaling", False)
        if can_skip_steps and self._has_nonfinite_loss is not None:
            # The gradients are means over the ranks, so one loss makes those of all ranks NaN.
            all_reduce(self._has_nonfinite_loss, op="max")
            self.optimizer.found_inf = self._has_nonfinite_loss
        super().step(**kwargs)
        self._has_nonfinite_loss = None
        self.optimizer.__dict__.pop("found_inf", None)  # set only if the optimizer can skip steps


@OPTIM_WRAPPERS.register_module()
class MapAmpOptimWrapper(_LateNorm, AmpOptimWrapper):
    """mmengine's `AmpOptimWrapper`, which reads the gradient norm only when it is logged.

    Its gradient scaler already skips steps with gradients that are not finite.
    """


def use_mixed_precision(settings: dict[str, Any], on_gpu: bool) -> None:
    """Set the type of an optimizer wrapper to mixed precision, in place.

    Args:
        settings: Settings of the wrapper in a config.
        on_gpu: Whether the model is trained on a GPU, in float16 with a scaled loss. On a CPU, it
            is trained in bfloat16.
    """
    if on_gpu:
        settings["type"] = "MapAmpOptimWrapper"
        settings.setdefault("loss_scale", "dynamic")
    else:
        settings["type"] = "CPUAutocastOptimWrapper"


@OPTIM_WRAPPER_CONSTRUCTORS.register_module()
class MergedGroupsConstructor(DefaultOptimWrapperConstructor):
    """mmengine's constructor, with one group for all parameters of equal settings.

    With ``paramwise_cfg``, mmengine makes one group per parameter, and an optimizer step on a GPU
    becomes hundreds of steps of one parameter each. On a GPU, a step is computed by a fused kernel
    unless ``optim_wrapper`` has ``fused_on_gpu=False``. A value of ``optimizer.fused`` or
    ``optimizer.foreach`` in the config is left as it is.
    """

    def __init__(self, optim_wrapper_cfg: dict, paramwise_cfg: dict | None = None) -> None:
        super().__init__(optim_wrapper_cfg, paramwise_cfg=paramwise_cfg)
        # The setting is removed, because mmengine passes the others to the wrapper.
        self.fused_on_gpu = self.optim_wrapper_cfg.pop("fused_on_gpu", True)
        self._members: list[list[int]] = []

    def add_params(
        self, params: list[dict], module: nn.Module, prefix: str = "", is_dcn_module: Any = None
    ) -> None:
        """Add the parameter groups of a module, and merge equal groups at the end.

        mmengine calls this method with the whole model, if the config has ``paramwise_cfg``, and
        the method of the base class calls it for each submodule.

        Args:
            params: Parameter groups so far; changed in place.
            module: Module whose parameters are added.
            prefix: Dotted name of the module; empty for the whole model, whose groups are merged.
            is_dcn_module: Whether the module lies in a deformable convolution; an argument of
                mmengine, which is passed on.
        """
        super().add_params(params, module, prefix=prefix, is_dcn_module=is_dcn_module)
        if prefix:
            return
        # There is one group per parameter, so the index of a group is also the position of its
        # parameter in the order of the model. Settings may be lists, so their text is the key.
        indices_by_settings: dict[str, list[int]] = {}
        for index, group in enumerate(params):
            settings = sorted(_group_settings(group).items())
            indices_by_settings.setdefault(repr(settings), []).append(index)
        self._members = list(indices_by_settings.values())
        merged_groups = []
        for indices in self._members:
            group_params = []
            for index in indices:
                group_params.extend(params[index]["params"])
            merged_groups.append({**params[indices[0]], "params": group_params})
        params[:] = merged_groups  # in place, because mmengine continues with this list

    def __call__(self, model: nn.Module) -> OptimWrapper:
        """Build the optimizer of a model and its wrapper."""
        optimizer_type = self.optimizer_cfg["type"]
        if isinstance(optimizer_type, str):
            optimizer_type = OPTIMIZERS.get(optimizer_type)
        arguments = set(inspect.signature(optimizer_type).parameters)
        unset_arguments = arguments - set(self.optimizer_cfg)
        on_gpu = all(param.device.type != "cpu" for param in model.parameters())
        # The optimizer has both settings, and the config sets neither of them.
        may_choose_kernel = set(_KERNELS) <= unset_arguments
        if self.fused_on_gpu and on_gpu and may_choose_kernel:
            self.optimizer_cfg["fused"] = True
        # This calls `add_params`, which sets `_members`, but only if there is a `paramwise_cfg`.
        wrapper = super().__call__(model)
        wrapper.members = self._members
        return wrapper


def _group_settings(group: dict[str, Any]) -> dict[str, Any]:
    """Return a parameter group without its parameters."""
    settings = dict(group)
    settings.pop("params", None)
    return settings


def fit_optimizer_state(checkpoint: dict[str, Any], wrapper: Any) -> None:
    """Convert the optimizer and scheduler states of a checkpoint to merged groups, in place.

    The checkpoint may have one group per parameter, as mmengine's constructor makes them. Its
    groups are then merged like the groups of this run. The checkpoint may also come from a run on
    another kind of device. Therefore the choice of kernels (fused, foreach) is copied from the
    optimizer of this run.

    Args:
        checkpoint: Checkpoint of a training, possibly without an optimizer.
        wrapper: Wrapper of this run's optimizer. If it has no ``members``, because its class is not
            from this file, the checkpoint is not changed.

    Raises:
        ValueError: If parameters of one merged group have different settings in the checkpoint.
    """
    state = checkpoint.get("optimizer")
    members: list[list[int]] | None = getattr(wrapper, "members", None)
    if members is None or not isinstance(state, dict) or "param_groups" not in state:
        return
    groups = state["param_groups"]
    param_count = sum(len(indices) for indices in members)
    group_sizes = [len(group["params"]) for group in groups]
    has_group_per_param = group_sizes == [1] * param_count
    if len(groups) > len(members) and has_group_per_param:
        _merge_state(state, members=members)
        # mmengine may append a group with the optimizer's base settings after all other groups.
        num_extra_groups = len(wrapper.param_groups) - len(members)
        if not num_extra_groups:
            state.pop("base_param_settings", None)
        for scheduler in _scheduler_states(checkpoint.get("param_schedulers")):
            for name in _SCHEDULER_LISTS:
                if name not in scheduler:
                    continue
                values = scheduler[name]
                # The settings of the parameters of a merged group are equal: take the first one's.
                group_values = [values[indices[0]] for indices in members]
                extra_values = values[param_count : param_count + num_extra_groups]
                scheduler[name] = group_values + extra_values
    run_groups = wrapper.optimizer.param_groups
    # A different number of groups is reported later, when torch loads the state.
    for group, run_group in zip(state["param_groups"], run_groups, strict=False):
        for name in _KERNELS:
            if name in run_group and name in group:
                group[name] = run_group[name]


def _merge_state(state: dict[str, Any], members: Sequence[Sequence[int]]) -> None:
    """Merge an optimizer state of one group per parameter, in place.

    Torch numbers the parameters in the order of the groups. The number of a parameter is its key in
    ``state["state"]``, whose values are moments and the like.

    Args:
        state: State of the optimizer; parameters are renumbered in the order of the merged groups.
        members: Indices of the former groups that each merged group replaces.

    Raises:
        ValueError: If groups with different settings would be merged.
    """
    groups = state["param_groups"]
    param_states = state["state"]
    merged_groups = []
    merged_states = {}
    next_param = 0
    for indices in members:
        settings = _group_settings(groups[indices[0]])
        new_numbers = []
        for index in indices:
            if _group_settings(groups[index]) != settings:
                raise InputError(
                    "the checkpoint's parameter groups differ in settings that are equal in the "
                    "config: resume with the config that it was trained with, or start a new run "
                    "from it (load_from=...)."
                )
            if index in param_states:  # not if the parameter has never had a gradient
                merged_states[next_param] = param_states[index]
            new_numbers.append(next_param)
            next_param += 1
        merged_groups.append({**settings, "params": new_numbers})
    state["param_groups"] = merged_groups
    state["state"] = merged_states


def _scheduler_states(states: Any) -> list[dict]:
    """Return the states of schedulers from a list, a dictionary of lists, or None.

    mmengine saves a dictionary if a run has several optimizers.
    """
    if not isinstance(states, dict):
        return list(states or ())
    flat_states = []
    for group_states in states.values():
        flat_states.extend(group_states)
    return flat_states
