"""What shards are joined to is, byte for byte, what the command makes without ``--shard``."""

import pickle
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from argoverse2_road import write_log

from gsmap.converters.custom import from_records
from gsmap.datasets.annotations.file import CLASSES, AnnotationFile, AnnotationMeta
from gsmap.utils.shards import WHOLE, Shard
from tools import create_data
from tools.merge import main as merge


def run(monkeypatch, *words: str | Path) -> None:
    monkeypatch.setattr(sys, "argv", ["tools/create_data.py", *map(str, words)])
    create_data.make()


def assert_joined(make: Callable[[Shard], object], target: Path, count: int) -> list[int]:
    """Make a file at once and from shards, and return how many samples each shard has."""
    make(WHOLE)
    whole = target.read_bytes()
    target.unlink()
    for index in reversed(range(count)):
        make(Shard(index, count))
    parts = [AnnotationFile(Shard(i, count).path_of(target)) for i in range(count)]
    assert merge([str(target)]) == f"{target}: {sum(map(len, parts))} samples of {count} shards"
    assert target.read_bytes() == whole
    return list(map(len, parts))


def words_of(shard: Shard) -> list[str]:
    return ["--shard", f"{shard.index}/{shard.count}"] if shard.count else []


@pytest.mark.parametrize(("split", "samples"), [("train", [0, 2, 0]), ("val", [0, 0, 2])])
def test_nuscenes_scenes(split, samples, minicity_root, tmp_path, monkeypatch):
    def make(shard: Shard) -> None:
        words = ("nuscenes", "--root", minicity_root, "--workers", "1", "--out-dir", tmp_path)
        run(monkeypatch, *words, *words_of(shard))

    target = tmp_path / f"gsmap_minicity_{split}.arrow"
    assert sorted(assert_joined(make, target, 3)) == sorted(samples)


def test_argoverse2_logs(tmp_path, monkeypatch):
    for name in "abc":
        write_log(tmp_path / "val" / f"log-{name}")

    def make(shard: Shard) -> None:
        run(monkeypatch, "av2", "--root", tmp_path, "--workers", "1", *words_of(shard))

    assert assert_joined(make, tmp_path / "gsmap_av2_val.arrow", 2) == [2, 4]


def test_info_files(tmp_path, monkeypatch):
    still = {"e2g_translation": [0, 0, 0], "e2g_rotation": [1, 0, 0, 0], "cams": {}}
    entries = [
        {"token": str(i), "timestamp": i, "log_id": "log", "lidar_path": f"val/{i}.feather"}
        | still
        | {"annotation": {name: [] for name in CLASSES}}
        for i in range(5)
    ]
    infos, target = tmp_path / "av2_map_infos_val.pkl", tmp_path / "val.arrow"
    infos.write_bytes(pickle.dumps({"samples": entries}))

    def make(shard: Shard) -> None:
        run(monkeypatch, "infos", infos, target, "--data-root", tmp_path, *words_of(shard))

    assert assert_joined(make, target, 2) == [2, 3]


def test_own_records_and_other_ones_among_them(tmp_path):
    """400 samples fill several batches of a file, which shards cut elsewhere."""
    meta = AnnotationMeta("mine", "ego", "train")
    records = [
        {"token": f"t{i}", "cameras": [], "instances": [{"label": 0, "points": np.eye(2) * i}]}
        for i in range(400)
    ]
    target = tmp_path / "a.arrow"

    def make(shard: Shard) -> None:
        from_records(target, iter(records), meta, tmp_path, shard)

    assert assert_joined(make, target, 3) == [133, 133, 134]
    from_records(target, records[1:], meta, tmp_path, Shard(1, 3))
    with pytest.raises(ValueError, match="shards of different work, by input"):
        merge([str(target)])


def test_shards_without_any_sample_are_no_file(tmp_path):
    for index in (0, 1):
        meta = AnnotationMeta("mine", "ego", "train")
        from_records(tmp_path / "a.arrow", [], meta, tmp_path, Shard(index, 2))
    with pytest.raises(ValueError, match=r"no shard of .* has a sample"):
        merge([str(tmp_path / "a.arrow")])
