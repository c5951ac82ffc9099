"""A result file on its way: one process at a time, and a killed one's work is taken up."""

import json

import pytest

from gsmap.apis.result_log import ResultLog


def test_two_processes_cannot_write_one_file(tmp_path):
    out = tmp_path / "map.json"
    with ResultLog(out, {"model": "a"}) as first:
        first.add("t0", [])
        with (
            pytest.raises(RuntimeError, match=r"another process writes .*map.json.unfinished"),
            ResultLog(out, {"model": "b"}),
        ):
            pass
        first.add("t1", [])
    with ResultLog(out, {"model": "a"}) as second:  # the first ended before it was done
        assert second.done == {"t0", "t1"}
        assert second.finish({}) == 2
    assert [r["sample_token"] for r in json.loads(out.read_text())["results"]] == ["t0", "t1"]


HEAD = '{"model": "a"}'
FRAME = '{"sample_token":"t0","vectors":[]}'
LINE = '{"sample_token":"t0","vectors":[{"pts":%s,"cls_name":"%s","confidence_level":%s}]}'


@pytest.mark.parametrize(
    "lines",
    [
        ["ssh-ed25519 AAAA me"],
        ["[]"],
        [HEAD, "ssh-ed25519 AAAA me"],
        [HEAD, FRAME, "\0\0\0\0"],
        [HEAD, FRAME, FRAME],
        [HEAD, FRAME, '{"sample_token":"of another file","vectors":[]}'],
        [HEAD, '{"sample_token":1,"vectors":[]}'],
        [HEAD, '{"sample_token":["t0"],"vectors":[]}'],
        [HEAD, '{"sample_token":"t0","vectors":[1]}'],
        [HEAD, '{"sample_token":"t0","broken":2}'],
        [HEAD, '{"sample_token":"t0","vectors":[{}]}'],
        [HEAD, LINE % ("[[0,0],[NaN,1]]", "divider", "0.5")],
        [HEAD, LINE % ("[[0,0],[1,1]]", "divider", "7")],
        [HEAD, LINE % ("[[0,0],[1,1]]", "of another model", "0.5")],
        [HEAD, '["sample_token"]'],
        [HEAD, "[" * 100_000],
    ],
)
def test_a_file_that_is_no_log_of_the_run_is_left_as_it_is(lines, tmp_path):
    out = tmp_path / "map.json"
    text = "\n".join(lines) + "\n"
    (tmp_path / "map.json.unfinished").write_text(text)
    with (
        pytest.raises(ValueError, match=r"map.json.unfinished, line \d, is no frame of this run"),
        ResultLog(out, {"model": "a"}, ["t0", "t1"], ["divider"]),
    ):
        pass
    assert (tmp_path / "map.json.unfinished").read_text() == text
    assert not out.exists()


def test_elements_of_a_class_of_the_run_are_taken_up(tmp_path):
    out = tmp_path / "map.json"
    line = LINE % ("[[0,0],[1,1]]", "divider", "0.5")
    (tmp_path / "map.json.unfinished").write_text(f"{HEAD}\n{line}\n")
    with ResultLog(out, {"model": "a"}, ["t0"], ["divider"]) as log:
        assert log.done == {"t0"}
        log.finish({})
    assert json.loads(out.read_text())["results"] == [json.loads(line)]


def test_a_frame_that_an_earlier_version_has_noted_as_broken_is_tried_again(tmp_path):
    out = tmp_path / "map.json"
    noted = '{"sample_token":"t0","broken":"no image"}'
    (tmp_path / "map.json.unfinished").write_text(f"{HEAD}\n{noted}\n")
    with ResultLog(out, {"model": "a"}, ["t0", "t1"], ["divider"]) as log:
        assert log.done == set()
        log.add("t0", [])
        assert log.finish({}) == 1
    assert json.loads(out.read_text())["results"] == [json.loads(FRAME)]


def test_frames_of_other_settings_are_counted(tmp_path):
    out = tmp_path / "map.json"
    (tmp_path / "map.json.unfinished").write_text(f"{HEAD}\n{FRAME}\n")
    with ResultLog(out, {"model": "b"}, ["t1"]) as log:
        assert (log.done, log.dropped) == (set(), 1)
        log.add("t1", [])
        assert log.finish({}) == 1
    assert not (tmp_path / "map.json.unfinished").exists()


def test_a_full_disk_is_named(tmp_path, monkeypatch):
    with ResultLog(tmp_path / "map.json", {"model": "a"}) as log:
        full = open("/dev/full", "wb", buffering=0)  # noqa: SIM115 - closed by the log
        log._file.close()
        log._file = full
        with pytest.raises(OSError, match=r"No space left on device: '.*map.json.unfinished'"):
            log.add("t0", [])
