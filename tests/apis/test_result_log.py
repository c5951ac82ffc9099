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
