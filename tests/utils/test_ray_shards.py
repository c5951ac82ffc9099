"""All shards on a local Ray cluster of two nodes: what is killed, hangs or fails."""

import argparse
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from gsmap.utils.ray_shards import _Run, run_on_ray
from gsmap.utils.shards import WHOLE, Shard, find_shards

COMMAND = """
import os, signal, sys, time
from pathlib import Path
from gsmap.utils.shards import Shard

assert sys.argv[1:3] == ["--root", "a b"] and sys.argv[-2] == "--shard" and len(sys.argv) == 5
shard = Shard.parse(sys.argv[-1])
first = not Path(f"tried{shard.index}").exists()
Path(f"tried{shard.index}").touch()
if first and shard.index == 1:
    os.kill(os.getppid(), signal.SIGKILL)  # Ray's worker, and this process with it
    time.sleep(60)
if first and shard.index == 2:
    os.kill(os.getpid(), signal.SIGTERM)
if first and shard.index == 3:
    time.sleep(60)
if shard.index == int(Path("bad").read_text()):
    sys.exit("error: of the user's making")
target = Path("all.txt")
shard.path_of(target).write_text(str(shard.index))
shard.write_manifest(target, "text", "", {}, 1)
"""


@pytest.fixture(scope="module")
def cluster():
    ray = pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    found = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    found.add_node(num_cpus=1)
    ray.init(address=found.address, log_to_driver=False)
    assert ray.cluster_resources()["CPU"] == 2
    yield found
    ray.shutdown()
    found.shutdown()


def arguments(shards: int, shard: Shard) -> argparse.Namespace:
    return argparse.Namespace(shards=shards, per_shard=[("num_cpus", 1.0)], shard=shard)


def make(folder: Path, monkeypatch, bad: int) -> str:
    monkeypatch.chdir(folder)
    Path("make.py").write_text(COMMAND)
    Path("bad").write_text(str(bad))
    words = ["make.py", "--root", "a b", "--executor", "ray", "--shards=5"]
    return run_on_ray(arguments(5, WHOLE), [*words, "--per-shard", "num_cpus=1"], patience_s=2.0)


@pytest.mark.faults
def test_a_killed_worker_a_killed_shard_and_a_hanging_one_lose_nothing(
    cluster, tmp_path, monkeypatch
):
    said = make(tmp_path, monkeypatch, bad=-1)
    assert re.match(r"5 shards made, .* [1-5] run twice at once", said)
    found = find_shards(tmp_path / "all.txt")
    assert [file.path.read_text() for file in found] == list("01234")


@pytest.mark.faults
def test_a_shard_that_fails_is_named_and_the_others_are_made(cluster, tmp_path, monkeypatch):
    for index in range(5):
        (tmp_path / f"tried{index}").touch()
    with pytest.raises(RuntimeError, match=r"1 of 5 shards failed: 4/5 .* code 1: error: of the"):
        make(tmp_path, monkeypatch, bad=4)
    with pytest.raises(FileNotFoundError, match="lacks 1 of its 5 shards: 4"):
        find_shards(tmp_path / "all.txt")


@pytest.mark.parametrize(
    ("resources", "has_room"),
    [
        ({}, True),
        ({"num_cpus": 2, "num_gpus": 1, "memory": 1000}, True),
        ({"num_cpus": 3}, False),
        ({"num_gpus": 2}, False),
        ({"memory": 1001}, False),
    ],
)
def test_a_second_copy_of_a_shard_needs_all_of_its_resources(resources, has_room):
    free = {"CPU": 2.0, "GPU": 1.0, "memory": 1000.0}
    ray = SimpleNamespace(available_resources=lambda: free)
    run = _Run(ray=ray, words=[], count=1, resources=resources, patience_s=1.0)
    assert run._has_room() == has_room


def test_without_ray_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(RuntimeError, match=r"pip install -e .\[ray\]"):
        run_on_ray(arguments(2, WHOLE), ["make.py"])


@pytest.mark.parametrize(("shards", "shard"), [(0, WHOLE), (2, Shard(0, 2))])
def test_a_shard_and_all_shards_exclude_each_other(shards, shard):
    with pytest.raises(ValueError, match="--shards N of at least 1, and no --shard"):
        run_on_ray(arguments(shards, shard), ["make.py"])
