"""Figures of iterations that stay on a GPU until someone looks at their history."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from mmdet3d.registry import HOOKS
from mmengine.hooks import RuntimeInfoHook
from mmengine.logging import HistoryBuffer, MessageHub
from mmengine.model import is_model_wrapper
from mmengine.runner import Runner
from torch import Tensor

_MOST_ROWS = 1000  # that nobody has looked at


class _Waiting:
    """Figures on a device that histories have not read yet, the oldest first."""

    def __init__(self) -> None:
        self.rows: list[tuple[Sequence[LateHistory], Tensor]] = []

    def add(self, histories: Sequence["LateHistory"], values: Tensor) -> None:
        """Add a figure to each history. (len(histories),)"""
        if len(self.rows) >= _MOST_ROWS:
            self.read()
        self.rows.append((histories, values))

    def read(self) -> None:
        """Read all figures in one copy, and let their histories have them."""
        rows, self.rows = self.rows, []
        if not rows:
            return
        numbers = iter(torch.cat([values for _, values in rows]).tolist())
        new: dict[int, tuple[LateHistory, list[float]]] = {}
        for histories, _ in rows:
            for history in histories:
                new.setdefault(id(history), (history, []))[1].append(next(numbers))
        for history, values in new.values():
            history.extend(values)


class LateHistory(HistoryBuffer):
    """A history of one figure whose latest values are read from a device when they are wanted.

    It is copied and saved as mmengine's `HistoryBuffer`.

    Args:
        history: What there is so far.
        waiting: Where its later values wait.
    """

    def __init__(self, history: HistoryBuffer, waiting: _Waiting) -> None:
        self._waiting = waiting
        super().__init__(*history.data, history.max_length)

    @property
    def _log_history(self) -> Any:
        self._waiting.read()
        return self._values

    @_log_history.setter
    def _log_history(self, values: Any) -> None:
        self._values = values

    @property
    def _count_history(self) -> Any:
        self._waiting.read()
        return self._counts

    @_count_history.setter
    def _count_history(self, counts: Any) -> None:
        self._counts = counts

    def extend(self, values: Sequence[float]) -> None:
        """Add values, each of one iteration."""
        self._values = np.append(self._values, values)[-self.max_length :]
        self._counts = np.append(self._counts, [1] * len(values))[-self.max_length :]

    def __reduce__(self) -> Any:
        return HistoryBuffer, (*self.data, self.max_length)


def keep_figures(hub: MessageHub, figures: Mapping[str, Any]) -> None:
    """Add figures of an iteration to the histories of a message hub.

    Figures on a GPU are not waited for: they are read together, once anyone reads a history.

    Args:
        hub: mmengine's message hub.
        figures: Scalars by name, tensors or numbers.
    """
    scalars = hub.log_scalars
    late: dict[LateHistory, Tensor] = {}
    waiting = next((h._waiting for h in scalars.values() if isinstance(h, LateHistory)), _Waiting())
    for name, value in figures.items():
        if not isinstance(value, Tensor) or value.device.type == "cpu" or name not in scalars:
            hub.update_scalar(name, value)
            continue
        history = scalars[name]
        if not isinstance(history, LateHistory):
            history = scalars[name] = LateHistory(history, waiting)
        late[history] = value.detach()
    if late:
        waiting.add(list(late), torch.stack([value.reshape(()) for value in late.values()]))


@HOOKS.register_module()
class MapRuntimeInfoHook(RuntimeInfoHook):
    """mmengine's hook, which on a GPU waits for no figure of an iteration until a line is logged.

    A loss that is not finite ends the run one iteration later there; what is still open at the end
    of an epoch or of the training is checked then.
    """

    def after_train_iter(
        self, runner: Runner, batch_idx: int, data_batch: Any = None, outputs: dict | None = None
    ) -> None:
        """Keep the figures of an iteration."""
        figures = {f"train/{name}": value for name, value in (outputs or {}).items()}
        keep_figures(runner.message_hub, figures)

    def after_train_epoch(self, runner: Runner) -> None:
        """Check the losses of the last iteration."""
        finish_checks(runner)

    def after_train(self, runner: Runner) -> None:
        """Check the losses of the last iteration."""
        finish_checks(runner)
        super().after_train(runner)


def finish_checks(runner: Runner) -> None:
    """Check the losses that a model has not checked yet.

    Raises:
        FloatingPointError: If one is not finite.
    """
    model = runner.model.module if is_model_wrapper(runner.model) else runner.model
    if hasattr(model, "loss_check"):
        model.loss_check.finish()
