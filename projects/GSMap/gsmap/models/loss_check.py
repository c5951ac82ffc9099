"""Whether the losses of a step are finite."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from gsmap.structures.tensors import LateValues
from gsmap.utils.errors import NotFiniteError


class LossCheck:
    """End a run whose losses are not finite: at once on a CPU, on a GPU at the next step.

    There the answer takes its way to the host while the step goes on; `finish` waits for it. A copy
    of a check has nothing to finish.
    """

    def __init__(self) -> None:
        self._open: tuple[LateValues, list[str], list[Any]] | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {"_open": None}

    def start(self, losses: Mapping[str, Tensor], tokens: Sequence[Any]) -> None:
        """Check the losses of a step, once those of the step before are found finite.

        Args:
            losses: Scalars by name.
            tokens: Names of the samples, for the message.

        Raises:
            FloatingPointError: If one was not, or is not on a CPU, with the losses and samples.
        """
        self.finish()
        values = torch.stack([loss.detach().float().reshape(()) for loss in losses.values()])
        self._open = LateValues(values.isfinite()), list(losses), list(tokens)
        if values.device.type == "cpu":
            self.finish()

    def finish(self) -> None:
        """Wait for the answer of the latest check, if it is not known yet.

        Raises:
            FloatingPointError: If a loss is not finite.
        """
        if self._open is None:
            return
        (finite, names, tokens), self._open = self._open, None
        bad = [name for name, good in zip(names, finite.read().tolist(), strict=True) if not good]
        if bad:
            raise NotFiniteError(
                f"losses {bad} are not finite; samples {tokens}: look at their images and ground "
                "truth, then at the learning rate and at the loss scale of mixed precision."
            )
