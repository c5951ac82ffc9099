"""Files of poses as spreadsheets and programs write them: read, or the line and the cause."""

import codecs

import numpy as np
import pytest

from mapdata.folders.poses import read_poses

HEAD = "timestamp_ns,x,y,z,qw,qx,qy,qz"
ROWS = [
    "1700000000000000000,0,0,0,1,0,0,0",
    "1700000000100000000,0.5,-2,1e1,0.7071068,0,0,0.7071068",
]
PLAIN = "\n".join([HEAD, *ROWS])


def poses_of(tmp_path, content, time_of=None, encoding="utf-8"):
    path = tmp_path / "poses.csv"
    path.write_bytes(content.encode(encoding))
    return read_poses(path, time_of or {}, np.eye(4))


@pytest.mark.parametrize(
    "text",
    [
        PLAIN,
        codecs.BOM_UTF8.decode() + PLAIN.replace("\n", "\r\n"),
        PLAIN.replace(",", ", "),
        PLAIN.replace(",", " ,\t"),
        PLAIN.replace(",", ";"),
        PLAIN.replace(",", ";").replace(".", ","),  # decimal commas
        PLAIN.replace(",", "\t"),
        "\n\n" + PLAIN.replace("\n", "\n\n") + "\n\n",
        PLAIN.replace("000,", "000.0,", 2),
        PLAIN.replace("timestamp_ns", '"timestamp_ns"'),
        "\n".join(f"{line},more" for line in PLAIN.splitlines()),
    ],
)
def test_the_ways_to_write_columns_give_the_same_poses(text, tmp_path):
    track = poses_of(tmp_path, text)
    assert track.times_ns.tolist() == [1700000000000000000, 1700000000100000000]
    np.testing.assert_allclose(track.poses[0], np.eye(4))
    quarter = [[0, -1, 0, 0.5], [1, 0, 0, -2], [0, 0, 1, 10], [0, 0, 0, 1]]
    np.testing.assert_allclose(track.poses[1], quarter, atol=1e-6)


def test_frames_are_names_of_images_with_or_without_their_suffix(tmp_path):
    text = "frame,x,y,z,qw,qx,qy,qz\n0001,0,0,0,1,0,0,0\n0002.png,1,0,0,1,0,0,0\nz,9,9,9,1,0,0,0"
    track = poses_of(tmp_path, text, {"0001": 5, "0002": 7})
    assert track.times_ns.tolist() == [5, 7]
    assert track.poses[1, 0, 3] == 1
    message = "none of its 3 frames is the name of an image: it has '0001', images are 'a'"
    with pytest.raises(ValueError, match=message):
        poses_of(tmp_path, text, {"a": 5})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "poses.csv cannot be used: it is empty"),
        (HEAD, "it holds no pose"),
        (
            "a,b\n1,2",
            r"first line must name the columns timestamp_ns or frame, x, .* has \['a', 'b'\]",
        ),
        (PLAIN.replace("qw", "w"), "it lacks qw and has"),
        (ROWS[0].replace(",", " "), "it lacks timestamp_ns or frame, x, y"),  # a trajectory of TUM
        (PLAIN.replace("0.5", "abc"), "line 3: x is 'abc', no finite number"),
        (PLAIN.replace("0.5", ""), "line 3: x is '', no finite number"),
        (PLAIN.replace("0.5", "nan"), "line 3: x is 'nan', no finite number"),
        (PLAIN.replace("1e1,0.7", "1e1,9.7"), "line 3: a quaternion must have length 1"),
        (PLAIN.rsplit(",", 1)[0], "line 3: it has 7 of 8 columns"),
        (PLAIN.replace("1700000000000000000", "1.7E+18"), "line 2: .*'1.7E.18', rounded as spread"),
        (PLAIN.replace("1700000000000000000", "1700000000.1"), "no whole number of nanoseconds"),
    ],
)
def test_what_is_wrong_with_a_line_is_named(text, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        poses_of(tmp_path, text)


def test_another_encoding_is_named(tmp_path):
    with pytest.raises(
        ValueError, match=r"poses.csv cannot be read: it is UTF-16; save it as UTF-8"
    ):
        poses_of(tmp_path, PLAIN, encoding="utf-16")
