"""Strict loading: every key of a checkpoint is used, and every weight of the model is loaded."""

from collections.abc import Callable, Mapping, Sequence

from torch import Tensor, nn

from gsmap.checkpoints.convert import ours_from_upstream, summarize_names
from gsmap.checkpoints.key_map import is_upstream
from gsmap.utils.errors import InputError


class AddsWeights:
    """Mixin for a module that adds weights to a model. A checkpoint may lack these weights.

    Attributes:
        neutral_keys: Prefixes, relative to the module, of the state keys of additional weights.
            At their initial values these have no effect, so a checkpoint may lack them.
    """

    neutral_keys: tuple[str, ...] = ()


def neutral_keys(model: nn.Module, prefix: str = "") -> list[set[str]]:
    """State keys of weights that a checkpoint may lack (`AddsWeights.neutral_keys`).

    Args:
        model: The model.
        prefix: Prefix of all keys.

    Returns:
        The keys of each declared prefix. A checkpoint must have all or none of the keys of a set.
    """
    groups: list[set[str]] = []
    state = model.state_dict(prefix=prefix)
    for name, module in model.named_modules():
        if not isinstance(module, AddsWeights):
            continue
        path = f"{prefix}{name}." if name else prefix
        for relative_prefix in module.neutral_keys:
            full_prefix = path + relative_prefix
            keys = {key for key in state if key.startswith(full_prefix)}
            groups.append(keys)
    return groups


def adapt_state(
    state: dict[str, Tensor],
    expected: Mapping[str, Tensor],
    prefix: str,
    neutral: Sequence[set[str]],
    fit: Callable[[dict[str, Tensor]], None] | None = None,
    allow_untrained: bool = True,
) -> None:
    """Rename upstream keys in a state in place, and compare the state with the model.

    Upstream keys are the names of weights in the code of a model's authors.

    Batch counters of BatchNorm may be missing, as in old checkpoints. Missing neutral weights are
    filled with the values of the model.

    Args:
        state: Weights of a checkpoint by key with ``prefix``; changed in place.
        expected: State of the model by key with ``prefix``.
        prefix: Prefix of all keys.
        neutral: Sets of keys that may be missing, all of a set together (`neutral_keys`).
        fit: Function of the model that changes the renamed state in place before the comparison,
            or None.
        allow_untrained: Whether neutral keys may be missing. If False, the state is filled as well
            before the error is raised.

    Raises:
        ValueError: If a key is missing or left over, or a weight has another shape. Also if neutral
            keys are missing although ``allow_untrained`` is False.
    """
    bare_state = {}
    for key, value in state.items():
        bare_state[key.removeprefix(prefix)] = value
    if is_upstream(bare_state):
        state.clear()  # the dictionary of the caller is filled with the renamed keys
        for key, value in ours_from_upstream(bare_state).items():
            state[prefix + key] = value
    if fit is not None:
        fit(state)
    # Absent keys are either allowed to be absent (untrained keys, batch counters) or missing.
    absent = expected.keys() - state.keys()
    untrained: list[str] = []
    for keys in neutral:
        if keys <= absent:  # if only a part of the set is absent, this part counts as missing
            untrained += keys
    untrained.sort()  # sets have no order, and the message names the first keys
    # Batch counters may be absent.
    missing = {key for key in absent if not key.endswith("num_batches_tracked")}
    missing -= set(untrained)
    for key in untrained:
        state[key] = expected[key]  # keeps the value of the model
    problems = _describe_mismatch(state, expected=expected, missing=sorted(missing))
    if problems:
        raise InputError(
            f"the checkpoint does not fit the model; {problems}. Load it with the "
            "config it was trained with; docs/migration.md lists the architectures that load."
        )
    if untrained and not allow_untrained:
        raise InputError(
            "the checkpoint was never trained with parts of the config's model: "
            f"{summarize_names(untrained)}. Give the config that it was trained with, or use these "
            "parts with their initial weights: --cfg-options model.allow_untrained=True."
        )


def _describe_mismatch(
    state: Mapping[str, Tensor], expected: Mapping[str, Tensor], missing: Sequence[str]
) -> str:
    """Describe the keys and shapes that differ between a state and the model's state.

    Args:
        state: Weights of a checkpoint.
        expected: State of the model.
        missing: Keys that the state lacks.

    Returns:
        The description; empty if the states match.
    """
    left_over: list[str] = []
    misshapen: list[str] = []
    for key, value in state.items():
        if key not in expected:
            left_over.append(key)
        elif value.shape != expected[key].shape:
            expected_shape = tuple(expected[key].shape)
            misshapen.append(f"{key} {tuple(value.shape)} instead of {expected_shape}")
    problems: list[str] = []
    if missing:
        problems.append(f"missing: {summarize_names(missing)}")
    if left_over:
        problems.append(f"left over: {summarize_names(left_over)}")
    if misshapen:
        problems.append(f"of another shape: {summarize_names(misshapen)}")
    return "; ".join(problems)
