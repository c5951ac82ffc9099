"""Check that the losses of a step are finite."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsmap.structures.tensors import LateValues
from gsmap.utils.errors import NotFiniteError


class PendingCheck(NamedTuple):
    """Check of one step whose result may still be on the way to the host.

    Attributes:
        is_finite: One value per loss, a copy on the host that is awaited when it is read.
        names: Names of the losses.
        tokens: Tokens of the samples.
    """

    is_finite: LateValues
    names: list[str]
    tokens: list[Any]


class LossCheck:
    """Check of losses that raises an error if one is not finite.

    On a CPU the error is raised in the same step, on a GPU in the next one.

    On a GPU the result is copied to the host while the step continues, and `finish` waits for it.
    A copy of the object has no pending check.
    """

    def __init__(self) -> None:
        self._pending: PendingCheck | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {"_pending": None}

    def start(self, losses: Mapping[str, Tensor], tokens: Sequence[Any]) -> None:
        """Finish the check of the previous step, and start the one of this step.

        Args:
            losses: Scalars by name.
            tokens: Tokens of the samples, for the message.

        Raises:
            FloatingPointError: If a loss of the previous step is not finite; on a CPU also if one
                of this step is not. The message names losses and samples.
        """
        self.finish()
        scalars = []
        for loss in losses.values():
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
        self._pending = None
        bad = []
        for name, is_finite in zip(check.names, check.is_finite.read().tolist(), strict=True):
            if not is_finite:
                bad.append(name)
        if bad:
            raise NotFiniteError(
                f"losses {bad} are not finite; samples {check.tokens}: look at their images and "
                "ground truth, then at the learning rate and at the loss scale of mixed precision."
            )
