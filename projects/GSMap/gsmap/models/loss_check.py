"""Check that the losses of a step are finite."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from gsmap.structures.tensors import LateValues
from gsmap.utils.errors import NotFiniteError


class LossCheck:
    """Raises an error if losses are not finite: at once on a CPU, in the next step on a GPU.

    On a GPU the result is copied to the host while the step continues, and `finish` waits for it.
    A copy of the object has no pending check.
    """

    def __init__(self) -> None:
        self._pending: tuple[LateValues, list[str], list[Any]] | None = None

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
        values = torch.stack([loss.detach().float().reshape(()) for loss in losses.values()])
        self._pending = (LateValues(values.isfinite()), list(losses), list(tokens))
        if values.device.type == "cpu":
            self.finish()

    def finish(self) -> None:
        """Wait for the result of a pending check.

        Raises:
            FloatingPointError: If a loss is not finite.
        """
        if self._pending is None:
            return
        result, names, tokens = self._pending
        self._pending = None
        is_finite = dict(zip(names, result.read().tolist(), strict=True))
        bad = [name for name in names if not is_finite[name]]
        if bad:
            raise NotFiniteError(
                f"losses {bad} are not finite; samples {tokens}: look at their images and ground "
                "truth, then at the learning rate and at the loss scale of mixed precision."
            )
