"""Frames that never continue a stream are named once; those that do, sometimes, are not."""

import numpy as np
import pytest

from gsmap.structures.streams import Frame, MapStream, Scenes, Slots, StreamState


def run(streams, times_s, scene="drive"):
    """Return the number of frames with memory."""
    num_continued = 0
    for number, time_s in enumerate(times_s):
        frame = Frame(str(number), scene, int(time_s * 1e9), np.eye(4))
        (state,) = streams.previous([frame])
        num_continued += state is not None
        streams.keep([StreamState(frame, {})])
    return num_continued


@pytest.mark.parametrize("kind", [Slots, Scenes, MapStream])
@pytest.mark.parametrize(
    ("times_s", "num_continued", "is_named"),
    [
        (np.arange(30) * 0.5, 29, False),
        (np.arange(100) * 3.0, 0, True),  # longer than 2 s
        (np.arange(15) * 3.0, 0, False),  # too few to say
        ([*range(3), *range(10, 150, 3)], 2, False),  # some continue
    ],
)
def test_a_memory_that_is_never_used_is_named_once(kind, times_s, num_continued, is_named, caplog):
    assert run(kind(2.0), times_s) == num_continued
    assert caplog.text.count("no memory of earlier frames: none of 20 frames continued") == is_named


def test_frames_without_times_are_named_in_training(caplog):
    assert run(Slots(2.0), [0.0] * 30, scene="") == 0
    assert caplog.text.count("The last one came 0.000 s after the frame before") == 1


def test_frames_of_other_scenes_are_no_gaps(caplog):
    slots = Slots(2.0)
    for number in range(50):
        assert run(slots, [0.0], scene=f"drive {number}") == 0
    assert caplog.text == ""
