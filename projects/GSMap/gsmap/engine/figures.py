"""Training scalars that stay on a GPU until a log line or a checkpoint needs them."""

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

_MAX_ROWS = 1000  # largest number of rows in the queue, one for each iteration


class _Waiting:
    """Queue of device values that have not been copied to their histories, oldest first.

    Each row has the values of one iteration: their histories, and a tensor with one value for each.
    """

    def __init__(self) -> None:
        self.rows: list[tuple[Sequence[LateHistory], Tensor]] = []

    def add(self, histories: Sequence["LateHistory"], values: Tensor) -> None:
        """Queue one value for each history. (len(histories),)"""
        if len(self.rows) >= _MAX_ROWS:  # bounds the memory without log lines
            self.read()
        self.rows.append((histories, values))

    def read(self) -> None:
        """Copy all queued values to the CPU at once, and append them to their histories."""
        rows = self.rows
        self.rows = []
        if not rows:
            return
        numbers = torch.cat([values for _, values in rows]).tolist()
        new_values: dict[LateHistory, list[float]] = {}
        position = 0
        for histories, _ in rows:
            for history in histories:
                new_values.setdefault(history, []).append(numbers[position])
                position += 1
        for history, values in new_values.items():
            history.extend(values)


class LateHistory(HistoryBuffer):
    """History of one scalar that copies its latest values from the device on access.

    Copies and pickles are plain `HistoryBuffer` objects of mmengine.

    Args:
        history: History of the previous iterations.
        waiting: Queue that holds the later values.
    """

    def __init__(self, history: HistoryBuffer, waiting: _Waiting) -> None:
        self._waiting = waiting
        values, counts = history.data
        # The base class stores both arrays by the setters of the two properties below.
        super().__init__(values, counts, max_length=history.max_length)

    @property
    def _log_history(self) -> Any:
        """Values of `HistoryBuffer`, which its methods read; the queue is emptied first."""
        self._waiting.read()
        return self._values

    @_log_history.setter
    def _log_history(self, values: Any) -> None:
        self._values = values

    @property
    def _count_history(self) -> Any:
        """Counts of `HistoryBuffer`: each of its values is a sum of this number of scalars."""
        self._waiting.read()
        return self._counts

    @_count_history.setter
    def _count_history(self, counts: Any) -> None:
        self._counts = counts

    def extend(self, values: Sequence[float]) -> None:
        """Append values, one per iteration."""
        counts = [1] * len(values)  # each value is one scalar, not a sum
        self._values = np.append(self._values, values=values)[-self.max_length :]
        self._counts = np.append(self._counts, values=counts)[-self.max_length :]

    # A copy or pickle is a plain history with all values, without the queue.
    def __reduce__(self) -> Any:
        values, counts = self.data
        return HistoryBuffer, (values, counts, self.max_length)


def _waiting_values(scalars: Mapping[str, HistoryBuffer]) -> _Waiting:
    """Return the queue that all late histories of a message hub share, or else a new queue."""
    for history in scalars.values():
        if isinstance(history, LateHistory):
            return history._waiting
    return _Waiting()


def keep_figures(hub: MessageHub, figures: Mapping[str, Any]) -> None:
    """Append the scalars of one iteration to the histories of a message hub.

    The host does not wait for scalars on a GPU. All of them are copied at once, on the next access
    to a history.

    Args:
        hub: Message hub of mmengine.
        figures: Scalars by name, tensors or numbers.
    """
    scalars = hub.log_scalars
    waiting = _waiting_values(scalars)
    histories: list[LateHistory] = []
    values: list[Tensor] = []
    for name, value in figures.items():
        on_device = isinstance(value, Tensor) and value.device.type != "cpu"
        # The first value of a scalar is not deferred: `update_scalar` creates the history.
        if not on_device or name not in scalars:
            hub.update_scalar(name, value)
            continue
        history = scalars[name]
        if not isinstance(history, LateHistory):
            history = LateHistory(history, waiting=waiting)
            scalars[name] = history
        histories.append(history)
        values.append(value.detach().reshape(()))
    if histories:
        waiting.add(histories, values=torch.stack(values))


@HOOKS.register_module()
class MapRuntimeInfoHook(RuntimeInfoHook):
    """mmengine's `RuntimeInfoHook`, without GPU synchronisation between log lines.

    The model checks that its losses are finite (``loss_check``). On a GPU, each check is one
    iteration late. At the end of each epoch and of the training, the hook runs the checks that are
    left.
    """

    def after_train_iter(
        self, runner: Runner, batch_idx: int, data_batch: Any = None, outputs: dict | None = None
    ) -> None:
        """Add the scalars of an iteration to the message hub.

        The base class would copy each scalar to the host, and so wait for the GPU. Its method is
        therefore not called.

        Args:
            runner: Runner of the training.
            batch_idx: Index of the iteration within its epoch; not used.
            data_batch: Batch of the iteration; not used.
            outputs: Losses and other scalars of the iteration, by name.
        """
        scalars = {f"train/{name}": value for name, value in (outputs or {}).items()}
        keep_figures(runner.message_hub, figures=scalars)

    def after_train_epoch(self, runner: Runner) -> None:
        """Check the losses of the last iteration of the epoch."""
        finish_checks(runner)

    def after_train(self, runner: Runner) -> None:
        """Check the losses of the last iteration."""
        finish_checks(runner)
        super().after_train(runner)


def finish_checks(runner: Runner) -> None:
    """Check the losses that a model has not checked yet. A model without checks is left alone.

    Args:
        runner: Runner of the training. Its model may be wrapped for distributed training.

    Raises:
        FloatingPointError: If a loss is not finite.
    """
    model = runner.model.module if is_model_wrapper(runner.model) else runner.model
    if hasattr(model, "loss_check"):
        model.loss_check.finish()
