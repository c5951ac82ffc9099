"""States of the random number generators, with which a resumed training goes on exactly."""

import random
from typing import Any

import numpy as np
import torch
from mmengine.runner import Runner

from gsmap.engine.resuming import refusal
from gsmap.utils.errors import InputError

RANDOM_STATES = "random_states"  # key in a checkpoint: states of all processes, by rank
_NUM_WORDS = 624  # words of a Mersenne Twister, the generator of Python and of numpy
# Classes of exception with which the libraries refuse a malformed state.
_FAULTS = (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)


def get_random_state() -> dict[str, Any]:
    """States of the generators of Python, numpy and torch in this process.

    Returns:
        The states by library, as numbers, texts, tuples and tensors. ``cuda`` is the state of the
        current GPU; it is absent without one.
    """
    numpy_state: Any = np.random.get_state()  # noqa: NPY002
    kind, words, position, has_gauss, gauss = numpy_state
    state = {
        "python": random.getstate(),
        "numpy": (kind, tuple(words.tolist()), position, has_gauss, gauss),
        "torch": torch.get_rng_state(),
    }
    if torch.cuda.is_available():
        state["cuda"] = torch.cuda.get_rng_state()
    return state


def set_random_state(state: dict[str, Any]) -> None:
    """Set the generators of this process to states from `get_random_state`.

    Raises:
        ValueError: If the position of numpy's generator lies outside of its words. numpy would read
            other memory.
        TypeError: If a state has another form. A malformed state may also raise a ``LookupError``,
            ``RuntimeError``, ``AttributeError`` or ``ArithmeticError``.
    """
    _, _, position, _, _ = state["numpy"]
    if type(position) is not int or not 0 <= position <= _NUM_WORDS:
        raise InputError(f"position {position!r:.40} of numpy's random numbers")
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])  # noqa: NPY002
    torch.set_rng_state(state["torch"].cpu())
    if "cuda" in state and torch.cuda.is_available():
        torch.cuda.set_rng_state(state["cuda"].cpu())


def resumed_random_state(checkpoint: dict[str, Any], runner: Runner) -> dict[str, Any] | None:
    """Return the state of this process from a checkpoint that a run is resumed from.

    Args:
        checkpoint: Content of the checkpoint; untrusted.
        runner: The resumed run.

    Returns:
        A valid state. None, with a message in the log, if the checkpoint is from an earlier version
        or from another number of processes.

    Raises:
        ValueError: If the state is malformed.
    """
    source = runner._load_from
    states = checkpoint.get(RANDOM_STATES)
    if not isinstance(states, list) or len(states) != runner.world_size:
        runner.logger.warning(
            f"The random numbers of the training (dropout) begin anew: {source} has none of "
            f"{runner.world_size} processes."
        )
        return None
    state = states[runner.rank]
    before = get_random_state()
    try:
        set_random_state(state=state)
    except _FAULTS as error:
        reason = f"its random numbers are malformed ({type(error).__name__}: {error})"
        raise refusal(path=source, reason=reason) from error
    finally:
        set_random_state(state=before)
    return state
