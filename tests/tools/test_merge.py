"""What shards are joined to is, byte for byte, what the command makes without ``--shard``."""

import json
import pickle
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from argoverse2_road import write_log
from mmdet3d.registry import MODELS

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.datasets.annotations.record import CLASSES, AnnotationMeta
from gsmap.engine.launch import read_config
from gsmap.evaluation.core.results_json import read_samples, vectors_of, write_results
from gsmap.structures.elements import MapElements
from gsmap.utils.shards import WHOLE, Shard, digest
from mapdata.custom import from_records
from tools import create_data, infer
from tools.evaluate import main as evaluate
from tools.merge import main as merge


def run(monkeypatch, *words: str | Path, command=create_data.make) -> None:
    monkeypatch.setattr(sys, "argv", ["tools/create_data.py", *map(str, words)])
    command()


def assert_same_file(make: Callable[[Shard], object], target: Path, count: int) -> None:
    """Make any file at once and from shards."""
    make(WHOLE)
    whole = target.read_bytes()
    target.unlink()
    for index in reversed(range(count)):
        make(Shard(index, count))
    merge([str(target)])
    assert target.read_bytes() == whole


def assert_joined(make: Callable[[Shard], object], target: Path, count: int) -> list[int]:
    """Make an annotation file at once and from shards; return how many samples each shard has."""
    assert_same_file(make, target, count)
    return [len(AnnotationFile(Shard(i, count).path_of(target))) for i in range(count)]


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

    assert assert_joined(make, tmp_path / "gsmap_av2_val.arrow", 2) == [3, 6]


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
    for others, join in ((records[1:], False), (records, True)):
        from_records(target, others, meta, tmp_path, Shard(1, 3), join=join)
        with pytest.raises(ValueError, match="different work, which differs in input"):
            merge([str(target)])


def test_shards_of_records_with_other_values_are_not_joined(tmp_path):
    """Poses, cameras and map are compared, too, of all records, in every shard."""
    meta = AnnotationMeta("mine", "ego", "train")
    target = tmp_path / "a.arrow"

    def records_of(**changes) -> list[dict]:
        """Four records, made anew, the last one with changes."""
        records = []
        line = {"label": 0, "points": np.array([[-20.0, 3], [40, 3]])}
        for number in range(4):
            camera = {"name": "front", "path": f"{number}.jpg", "width": 8, "height": 6}
            camera |= {"intrinsics": np.eye(3).tolist(), "cam_from_frame": np.eye(4)}
            pose = np.eye(4)
            pose[0, 3] = 5.0 * number
            item = {"token": str(number), "cameras": [camera], "global_from_frame": pose}
            records.append({**item, "global_instances": [line]})
        records[-1] |= changes
        return records

    def make(index: int, records: list[dict]) -> None:
        from_records(target, records, meta, tmp_path, Shard(index, 2))

    make(1, records_of())
    make(0, records_of())
    merge([str(target)])
    shifted = {"label": 0, "points": np.array([[-20.0, 5], [40, 5]])}
    camera = records_of()[-1]["cameras"][0]
    intrinsics = [[1.0, 0, 0.5], [0, 1, 0], [0, 0, 1]]
    for changes in (
        {"global_instances": [shifted]},
        {"global_instances": []},
        {"global_from_frame": np.diag([-1.0, -1, 1, 1])},
        {"cameras": [camera | {"intrinsics": intrinsics}]},
        {"cameras": [camera | {"path": "other.jpg"}]},
        {"cameras": []},
        {"timestamp_ns": 1},
        {"scene": "b"},
    ):
        make(0, records_of(**changes))
        with pytest.raises(ValueError, match="different work, which differs in input"):
            merge([str(target)])
    make(0, records_of())
    merge([str(target)])


def test_shards_without_any_sample_are_no_file(tmp_path):
    for index in (0, 1):
        meta = AnnotationMeta("mine", "ego", "train")
        from_records(tmp_path / "a.arrow", [], meta, tmp_path, Shard(index, 2))
    with pytest.raises(ValueError, match=r"no shard of .* has a sample"):
        merge([str(tmp_path / "a.arrow")])


@pytest.fixture(scope="module")
def predictions(tiny_config, minicity_annotations, tmp_path_factory):
    """Result file of a tiny model on two samples, made at once and from three shards."""
    folder = tmp_path_factory.mktemp("predictions")
    model, target = folder / "tiny.pth", folder / "map.json"
    torch.save(MODELS.build(read_config(tiny_config).model).state_dict(), model)

    def make(shard: Shard) -> None:
        words = (minicity_annotations["val"], "--model", tiny_config, model, "--device", "cpu")
        words += ("--out", target, *words_of(shard))
        with pytest.MonkeyPatch.context() as monkeypatch:
            run(monkeypatch, *words, command=infer.main)

    assert_same_file(make, target, 3)
    return target


def test_predictions_have_all_samples(predictions, minicity_annotations):
    tokens = AnnotationFile(minicity_annotations["val"]).column("token")
    assert sorted(tokens) == list(read_samples(predictions, "results", ())[0])


def test_predictions_of_another_model_are_refused(predictions, tmp_path):
    for path in predictions.parent.glob("map.*"):
        shutil.copy(path, tmp_path)
    odd = tmp_path / "map.00001-of-00003.json.manifest"
    found = json.loads(odd.read_text())
    found["options"]["checkpoint"] = "another"
    odd.write_text(json.dumps(found))
    before = (tmp_path / "map.json").read_bytes()
    with pytest.raises(ValueError, match="different work, which differs in checkpoint"):
        merge([str(tmp_path / "map.json")])
    assert (tmp_path / "map.json").read_bytes() == before


def test_a_sample_in_two_shards_is_refused(tmp_path):
    target = tmp_path / "map.json"
    for index in (0, 1):
        write_results(Shard(index, 2).path_of(target), [("a", []), (f"b{index}", [])])
        Shard(index, 2).write_manifest(target, "results", "", {}, 2)
    with pytest.raises(ValueError, match="sample 'a' twice"):
        merge([str(target)])
    assert not target.exists()


def line_and_ring(shift: float, *scores: float) -> list[dict]:
    line, ring = [[shift, -20.0], [shift, 20.0]], [[2, 2], [6, 2], [6, 8 + shift], [2, 2]]
    elements = MapElements.from_polylines([line, ring], [0, 1], scores or None)
    return vectors_of(elements, CLASSES)


@pytest.fixture
def scored(tmp_path) -> tuple[Path, Path]:
    """Results and ground truth of ten samples; every third has no prediction."""
    results, truth = tmp_path / "map.json", tmp_path / "truth.json"
    found = [(f"t{i}", line_and_ring(i / 9, i / 10, 0.5) if i % 3 else []) for i in range(10)]
    write_results(results, found)
    write_results(truth, [(f"t{i}", line_and_ring(0.0)) for i in reversed(range(10))], key="GTs")
    return results, truth


@pytest.mark.parametrize("metrics", [["chamfer"], ["chamfer", "raster"]])
def test_figures(scored, tmp_path, metrics, capsys):
    target = tmp_path / "metrics.json"

    def make(shard: Shard) -> None:
        words = [*map(str, scored), "--eval", *metrics, "--out", str(target), *words_of(shard)]
        evaluate(words)

    assert_same_file(make, target, 4)
    assert 0 < json.loads(target.read_text())["chamfer/mAP"] < 1
    tables = re.findall("^mAP_chamfer = .*", capsys.readouterr().out, re.MULTILINE)
    assert len(tables) == 2
    assert len(set(tables)) == 1


GRID = {"x_range": [-15, 15], "y_range": [-30, 30]}


@pytest.mark.parametrize(
    ("rules", "message"),
    [
        ({"metrics": []}, "contains no rules of metrics .*at least one"),
        ({"settings": {"classes": [["a"]]}}, "contains no rules .*classes must be different names"),
        ({"settings": []}, "contains no rules of metrics"),
        ({"metrics": ["os"]}, "contains no rules of metrics .*there is no metric"),
        ({"settings": {"classes": ["divider"]}}, "matches in .* do not fit the rules .*shapes"),
        ({"settings": {"classes": list(CLASSES), "thresholds": [1]}}, "do not fit the rules"),
        ({"metrics": ["chamfer", "raster"]}, "do not fit the rules .*'raster'"),
    ],
)
def test_forged_rules_of_figures_are_refused(rules, message, scored, tmp_path):
    target = tmp_path / "metrics.json"
    evaluate([*map(str, scored), "--eval", "chamfer", "--out", str(target), "--shard", "0/1"])
    path = tmp_path / "metrics.00000-of-00001.json.manifest"
    manifest = json.loads(path.read_text())
    manifest["options"]["evaluator"] |= rules
    path.write_text(json.dumps(manifest))
    with pytest.raises(ValueError, match=message):
        merge([str(target)])
    assert not target.exists()


def test_forged_matches_are_refused(scored, tmp_path):
    target = tmp_path / "metrics.json"
    evaluate([*map(str, scored), "--eval", "chamfer", "--out", str(target), "--shard", "0/1"])
    path = tmp_path / "metrics.00000-of-00001.json"
    content = bytearray(path.read_bytes())
    content[content.index(b"PK\x01\x02") + 10] = 99  # a compression that nobody knows
    path.write_bytes(content)
    manifest = json.loads(path.with_name(f"{path.name}.manifest").read_text())
    manifest["sha256"] = digest(path)
    path.with_name(f"{path.name}.manifest").write_text(json.dumps(manifest))
    with pytest.raises(ValueError, match=r"matches in .* do not fit the rules"):
        merge([str(target)])


def test_matches_without_numbers_of_notes_are_joined(scored, tmp_path):
    """Earlier versions wrote the numbers into the texts."""
    target = tmp_path / "metrics.json"
    evaluate([*map(str, scored), "--eval", "chamfer", "--out", str(target), "--shard", "0/1"])
    path = tmp_path / "metrics.00000-of-00001.json"
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files if name != "note_numbers"}
    with path.open("wb") as file:
        np.savez_compressed(file, **arrays)
    manifest = json.loads(path.with_name(f"{path.name}.manifest").read_text())
    manifest |= {"sha256": digest(path), "bytes": path.stat().st_size}
    path.with_name(f"{path.name}.manifest").write_text(json.dumps(manifest))
    merge([str(target)])
    assert 0 < json.loads(target.read_text())["chamfer/mAP"] < 1


def test_figures_of_results_that_lie_in_shards(predictions, minicity_annotations, tmp_path):
    for path in predictions.parent.glob("map.*-of-*"):
        shutil.copy(path, tmp_path)
    target, truth = tmp_path / "metrics.json", str(minicity_annotations["val"])
    evaluate([str(predictions), truth, "--out", str(target)])
    whole = target.read_bytes()
    words = [str(tmp_path / "map.json"), truth, "--out", str(target)]
    for index in range(3):
        evaluate([*words, "--shard", f"{index}/3"])
    merge([str(target)])
    assert target.read_bytes() == whole


@pytest.mark.parametrize("annotated", [True, False], ids=["annotations", "json"])
def test_elements_that_are_not_scored_are_added_up(
    annotated, scored, predictions, minicity_annotations, tmp_path, capsys
):
    files = scored
    if annotated:
        files = (predictions, minicity_annotations["val"])
    words = [*map(str, files), "--out", str(tmp_path / "m.json"), "--classes", "divider"]

    def notes() -> set[str]:
        return set(re.findall("^note: (.*)", capsys.readouterr().out, re.MULTILINE))

    evaluate(words)
    whole = notes()
    for index in range(3):
        evaluate([*words, "--shard", f"{index}/3"])
    capsys.readouterr()
    merge([str(tmp_path / "m.json")])
    assert notes() == whole
    assert any("ground truths of class" in note for note in whole)


def test_what_a_shard_s_part_lacks_or_nobody_knows_is_an_error(scored, tmp_path):
    results, truth = scored
    words = [str(results), str(truth), "--out", str(tmp_path / "m.json"), "--shard", "1/2"]
    write_results(results, [(f"t{i}", []) for i in range(9)] + [("x", [])])
    with pytest.raises(ValueError, match=r"^1 result has no ground truth, such as 'x'"):
        evaluate(words)
    write_results(results, [(f"t{i}", []) for i in range(4)])
    with pytest.raises(ValueError, match=r"^1 sample has no results, such as 't4'"):
        evaluate(words)
