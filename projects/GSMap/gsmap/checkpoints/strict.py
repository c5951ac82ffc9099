"""Strict loading: every key is used and every weight is loaded, or an error names it."""

from collections.abc import Callable, Mapping, Sequence
from itertools import chain

from torch import Tensor, nn

from gsmap.checkpoints.convert import listed, ours_from_upstream
from gsmap.checkpoints.key_map import is_upstream
from gsmap.utils.errors import InputError


class AddsWeights:
    """A module that extends another one, as GSMap's extend MapTR's.

    Attributes:
        neutral_keys: What it adds without effect at the start: prefixes of state keys, relative to
            the module. A checkpoint may lack these.
    """

    neutral_keys: tuple[str, ...] = ()


def neutral_keys(model: nn.Module, prefix: str = "") -> list[set[str]]:
    """Return the state keys, behind ``prefix``, that modules declare neutral (`AddsWeights`).

    Returns:
        The keys of each declared prefix, which may be missing together only.
    """
    groups = []
    state = model.state_dict(prefix=prefix)
    for name, module in model.named_modules():
        path = f"{prefix}{name}." if name else prefix
        for relative in module.neutral_keys if isinstance(module, AddsWeights) else ():
            groups.append({key for key in state if key.startswith(path + relative)})
    return groups


def adapt_state(
    state: dict[str, Tensor],
    expected: Mapping[str, Tensor],
    prefix: str,
    neutral: Sequence[set[str]],
    fit: Callable[[dict[str, Tensor]], None] | None = None,
    allow_untrained: bool = True,
) -> None:
    """Rename upstream's keys in place, then compare the state with what the model expects.

    Batch counters of BatchNorm may be missing, as in old checkpoints.

    Args:
        state: What a checkpoint has, under ``prefix``.
        expected: What the model has, under ``prefix``.
        prefix: What the keys begin with.
        neutral: Keys that may be missing, those of a set all together (``neutral_keys``).
        fit: Changes the renamed state in place before it is compared.
        allow_untrained: Whether the neutral keys may be missing.

    Raises:
        ValueError: If a key is missing, left over or of another shape.
    """
    own = {key.removeprefix(prefix): value for key, value in state.items()}
    if is_upstream(own):
        state.clear()
        state.update({prefix + key: value for key, value in ours_from_upstream(own).items()})
    if fit is not None:
        fit(state)
    missing = {
        key for key in expected if key not in state and not key.endswith("num_batches_tracked")
    }
    untrained = sorted(chain.from_iterable(keys for keys in neutral if keys <= missing))
    missing -= set(untrained)
    state.update({key: expected[key] for key in untrained})  # they stay as they are
    problems = {
        "missing": sorted(missing),
        "left over": [key for key in state if key not in expected],
        "of another shape": [
            f"{key} {tuple(value.shape)} instead of {tuple(expected[key].shape)}"
            for key, value in state.items()
            if key in expected and value.shape != expected[key].shape
        ],
    }
    text = "; ".join(f"{what}: {listed(keys)}" for what, keys in problems.items() if keys)
    if text:
        raise InputError(
            f"the checkpoint does not fit the model; {text}. Load it with the config it was "
            "trained with; docs/migration.md lists the architectures that load."
        )
    if untrained and not allow_untrained:
        raise InputError(
            "the checkpoint was never trained with parts of the config's model: "
            f"{listed(untrained)}. Give the config that it was trained with, or use them as they "
            "start: --cfg-options model.allow_untrained=True."
        )
