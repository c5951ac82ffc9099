"""Figures that are read late: histories as if they had been read at once."""

import copy
import pickle

import numpy as np
import torch
from mmengine.logging import HistoryBuffer, MessageHub

import gsmap.registered  # noqa: F401
from gsmap.engine.figures import LateHistory, _Waiting


def late_history(*values: float) -> tuple[LateHistory, _Waiting]:
    waiting = _Waiting()
    return LateHistory(HistoryBuffer(list(values), [1] * len(values)), waiting), waiting


def test_values_are_read_when_a_history_is():
    (first, waiting), other = late_history(1.0), HistoryBuffer([], [])
    second = LateHistory(other, waiting)
    for value in (2.0, 3.0):
        waiting.add([first, second], torch.tensor([value, -value]))
    assert len(waiting.rows) == 2
    assert first.mean(2) == 2.5
    assert not waiting.rows
    assert second.current() == -3.0
    np.testing.assert_array_equal(first.data[0], [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(first.data[1], [1, 1, 1])
    first.update(4.0)
    assert first.max() == 4.0


def test_an_update_comes_after_what_waits():
    history, waiting = late_history(1.0)
    waiting.add([history], torch.tensor([2.0]))
    history.update(3.0)
    np.testing.assert_array_equal(history.data[0], [1.0, 2.0, 3.0])


def test_rows_that_nobody_reads_do_not_pile_up():
    history, waiting = late_history()
    for number in range(2500):
        waiting.add([history], torch.tensor([float(number)]))
        assert len(waiting.rows) <= 1000
    np.testing.assert_array_equal(history.data[0], np.arange(2500.0))


def test_a_history_is_saved_and_copied_as_mmengines():
    for copied in (copy.deepcopy, lambda value: pickle.loads(pickle.dumps(value))):
        history, waiting = late_history(1.0)
        waiting.add([history], torch.tensor([2.0]))
        found = copied(history)
        assert type(found) is HistoryBuffer
        np.testing.assert_array_equal(found.data[0], [1.0, 2.0])


def test_a_message_hub_saves_what_waits():
    hub = MessageHub.get_instance("test_a_message_hub_saves_what_waits")
    hub.update_scalar("train/loss", 1.0)
    waiting = _Waiting()
    hub.log_scalars["train/loss"] = history = LateHistory(hub.log_scalars["train/loss"], waiting)
    waiting.add([history], torch.tensor([2.0]))
    saved = hub.state_dict()["log_scalars"]["train/loss"]
    assert type(saved) is HistoryBuffer
    np.testing.assert_array_equal(saved.data[0], [1.0, 2.0])
