"""Check that the losses of a step are finite."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsmap.structures.tensors import LateValues
from gsmap.utils.errors import NotFiniteError


class PendingCheck(NamedTuple):
    """Check of one step, whose result may not have reached the host yet.

    Attributes:
        is_finite: One flag per loss. Reading them waits for the copy to the host.
        names: Names of the losses.
        tokens: Tokens of the samples.
    """

    is_finite: LateValues
    names: list[str]
    tokens: list[Any]


class LossCheck:
    """Check of losses that raises an error if a loss is not finite.

    On a CPU, the error is raised in the step of the loss, on a GPU in the next step: the result is
    copied to the host while the step continues, and `finish` waits for it. A copied or unpickled
    object has no pending check, because the event that `LateValues` waits for belongs to the step.
    """

    def __init__(self) -> None:
        self._pending: PendingCheck | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {"_pending": None}

    def start(self, losses: Mapping[str, Tensor], tokens: Sequence[Any]) -> None:
        """Finish the check of the previous step, and start the check of this step.

        Args:
            losses: Scalars by name.
            tokens: Tokens of the samples, for the message.

        Raises:
            FloatingPointError: If a loss of the previous step is not finite. On a CPU, also if a
                loss of this step is not finite. The message names losses and samples.
        """
        self.finish()
        scalars = []
        for loss in losses.values():
            # Losses may have one axis of length 1, and different types.
            scalars.append(loss.detach().float().reshape(()))
        values = torch.stack(scalars)
        self._pending = PendingCheck(
            is_finite=LateValues(values.isfinite()), names=list(losses), tokens=list(tokens)
        )
        if values.device.type == "cpu":
            self.finish()

    def finish(self) -> None:
        """Wait for the result of a pending check.

        Raises:
            FloatingPointError: If a loss is not finite.
        """
        if self._pending is None:
            return
        check = self._pending
        self._pending = None  # before the error, so that it is raised once
        bad = []
        flags = check.is_finite.read().tolist()
        for name, is_finite in zip(check.names, flags, strict=True):
            if not is_finite:
                bad.append(name)
        if bad:
            raise NotFiniteError(
                f"losses {bad} are not finite; samples {check.tokens}: look at their images and "
                "ground truth, then at the learning rate and at the loss scale of mixed precision."
            )
