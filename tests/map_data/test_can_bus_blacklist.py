import json

import numpy as np
import pytest

from mapdata.nuscenes.can_bus import read_messages, signals_at

MESSAGE = {
    "utime": 1_000_000,
    "accel": [1.0, 2.0, 3.0],
    "rotation_rate": [4.0, 5.0, 6.0],
    "vel": [7.0, 8.0, 9.0],
    "pos": [0.0, 0.0, 0.0],
    "orientation": [1.0, 0.0, 0.0, 0.0],
}


@pytest.mark.parametrize(
    ("scene", "signals"),
    [("scene-0160", [1, 2, 3, 4, 5, 6, 7, 8, 9]), ("scene-0162", [0] * 9)],
)
def test_scenes_that_the_devkit_refuses_have_no_signals(tmp_path, scene, signals):
    folder = tmp_path / "can_bus"
    folder.mkdir()
    (folder / f"{scene}_pose.json").write_text(json.dumps([MESSAGE]))
    values = signals_at(2_000_000_000, np.eye(4), read_messages(tmp_path, scene))
    np.testing.assert_array_equal(values[7:16], signals)
