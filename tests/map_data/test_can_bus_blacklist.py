import json

import numpy as np
import pytest

from mapdata.nuscenes.can_bus import is_rejected, read_messages, signals_at

MESSAGE = {
    "utime": 1_000_000,
    "accel": [1.0, 2.0, 3.0],
    "rotation_rate": [4.0, 5.0, 6.0],
    "vel": [7.0, 8.0, 9.0],
    "pos": [0.0, 0.0, 0.0],
    "orientation": [1.0, 0.0, 0.0, 0.0],
}


NUSCENES_LOG = "n015-2018-07-24-11-22-45+0800"


@pytest.mark.parametrize(
    ("scene", "logfile", "rejected"),
    [
        ("scene-0162", NUSCENES_LOG, True),
        ("scene-0314", "n008-2018-08-01-15-16-36-0400", True),
        ("scene-0160", NUSCENES_LOG, False),
        ("scene-0169", NUSCENES_LOG, False),
        ("scene-162", NUSCENES_LOG, False),
        ("scene-0162", "minicity-0-small", False),
        ("scene-0162", "", False),
        ("scene-0162", None, False),
        ("scene-0162", 15, False),
        ("scene-0162", "n015-my-drive", False),
    ],
)
def test_the_devkit_rejects_scenes_of_nuscenes_alone(tmp_path, scene, logfile, rejected):
    assert not is_rejected(tmp_path, scene, logfile=logfile)  # there is nothing to reject
    folder = tmp_path / "can_bus"
    folder.mkdir()
    (folder / f"{scene}_pose.json").write_text(json.dumps([MESSAGE]))
    assert is_rejected(tmp_path, scene, logfile=logfile) == rejected
    values = signals_at(2_000_000_000, np.eye(4), read_messages(tmp_path, scene))
    np.testing.assert_array_equal(values[7:16], [1, 2, 3, 4, 5, 6, 7, 8, 9])
