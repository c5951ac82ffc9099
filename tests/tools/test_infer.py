"""``tools/infer.py`` in this process: a nuScenes-format root, broken frames, a killed run."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from bag_cases import AXLE_M, Recorder, record
from mmdet3d.registry import MODELS

from gsmap import MapInferencer
from gsmap.datasets.annotations.file import AnnotationFile, write_annotations
from gsmap.datasets.annotations.record import AnnotationMeta
from gsmap.datasets.source import change_frame
from gsmap.engine.launch import read_config
from gsmap.utils.shards import digest
from tools import infer
from tools.merge import main as merge


@pytest.fixture(scope="module")
def model(tiny_config, tmp_path_factory):
    """The words after ``--model``: a tiny config, and a checkpoint of random weights."""
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("model") / "weights.pth"
    torch.save({"state_dict": MODELS.build(read_config(tiny_config).model).state_dict()}, path)
    return [str(tiny_config), str(path)]


@pytest.fixture
def drive(minicity_root, tmp_path):
    """A copy of the root's tables, with links to its images."""
    for name in ("can_bus", "samples", "sweeps", "v1.0-trainval"):
        (tmp_path / "drive").mkdir(exist_ok=True)
        (tmp_path / "drive" / name).symlink_to(minicity_root / name)
    return tmp_path / "drive"


def results(path):
    return {r["sample_token"]: r["vectors"] for r in json.loads(path.read_text())["results"]}


def kill_at_the_third(monkeypatch) -> list[str]:
    """Interrupt a run at its third prediction; return the list of predicted tokens, which grows."""
    original = MapInferencer.elements
    tokens = []

    def predict(self, sample):
        tokens.append(sample.metainfo["token"])
        if len(tokens) == 3:
            raise KeyboardInterrupt
        return original(self, sample)

    monkeypatch.setattr(MapInferencer, "elements", predict)
    return tokens


def test_a_root_without_annotation_files_is_predicted_and_can_be_merged(
    drive, model, minicity_annotations, tmp_path, capsys
):
    out = tmp_path / "map.json"
    infer.main([str(drive), "--model", *model, "--out", str(out), "--batch-size", "3"])
    assert "4 of 4 samples predicted" in capsys.readouterr().out
    found = results(out)
    assert set(found) == {s.token for s in AnnotationFile(out.with_suffix(".arrow"))}
    assert not list(tmp_path.glob("*.unfinished"))
    known = tmp_path / "known.json"
    infer.main([str(minicity_annotations["val"]), "--model", *model, "--out", str(known)])
    for token, vectors in results(known).items():
        for a, b in zip(vectors, found[token], strict=True):
            # float32 sums in another order: a batch of 1 instead of 3
            assert a["confidence_level"] == pytest.approx(b["confidence_level"], abs=1e-5)


def test_results_of_an_annotation_file_are_in_its_frame(
    minicity_root, minicity_annotations, model, tmp_path
):
    """The LiDAR of nuScenes looks along its y axis, and is 0.94 m ahead of the rear axle."""
    ego = [change_frame(s, "lidar", "ego") for s in AnnotationFile(minicity_annotations["val"])]
    samples_of = {"ego": ego, "lidar": [change_frame(s, "ego", "lidar") for s in ego]}
    found = {}
    for frame, samples in samples_of.items():
        path = tmp_path / f"{frame}.arrow"
        write_annotations(path, AnnotationMeta("mine", frame, "val"), samples)
        out = tmp_path / f"{frame}.json"
        words = ["--data-root", str(minicity_root), "--model", *model, "--out", str(out)]
        infer.main([str(path), *words])
        found[frame] = results(out)
    assert found["lidar"].keys() == found["ego"].keys()
    for token, vectors in found["lidar"].items():
        assert len(vectors) == len(found["ego"][token]) > 0
        for in_lidar, in_ego in zip(vectors, found["ego"][token], strict=True):
            x, y = np.array(in_lidar["pts"]).T
            np.testing.assert_allclose(in_ego["pts"], np.stack([y + 0.94, -x], axis=1), atol=1e-2)
            assert in_ego["confidence_level"] == in_lidar["confidence_level"]


@pytest.mark.parametrize("repaired", [False, True])
def test_a_killed_run_goes_on_and_broken_frames_are_named_and_tried_again(
    repaired, drive, model, minicity_root, tmp_path, capsys, monkeypatch
):
    folder = tmp_path / "drive/samples"
    folder.unlink()
    for source in (minicity_root / "samples").rglob("*.*"):
        target = folder / source.relative_to(minicity_root / "samples")
        target.parent.mkdir(parents=True, exist_ok=True)
        target.symlink_to(source)
    broken = sorted((folder / "CAM_BACK").iterdir())[-1]
    broken.unlink()
    out = tmp_path / "map.json"
    words = [str(drive), "--model", *model, "--out", str(out)]
    original = MapInferencer.elements
    calls = kill_at_the_third(monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        infer.main(words)
    assert not out.exists()
    unfinished = tmp_path / "map.json.unfinished"
    unfinished.write_bytes(unfinished.read_bytes()[:-7])  # the kill cuts the last line
    monkeypatch.setattr(
        MapInferencer, "elements", lambda s, x: calls.append("again") or original(s, x)
    )
    if repaired:
        broken.symlink_to(minicity_root / "samples/CAM_BACK" / broken.name)
        infer.main(words)
    else:
        with pytest.raises(SystemExit) as end:
            infer.main(words)
        assert end.value.code == infer.SKIPPED
    predicted = 4 if repaired else 3
    assert calls.count("again") == predicted - 1  # the second line was cut
    printed = capsys.readouterr().out
    assert "going on after 1 of 4 samples" in printed
    assert f"{predicted} of 4 samples predicted" in printed
    assert broken.name in printed
    assert len(results(out)) == predicted
    assert not unfinished.exists()


@pytest.mark.parametrize("drawn_before", [False, True])
def test_a_run_that_goes_on_lacks_no_picture(drive, model, tmp_path, monkeypatch, drawn_before):
    pictures = tmp_path / "pictures"
    words = [str(drive), "--model", *model, "--out", str(tmp_path / "map.json")]
    draw = ["--show-dir", str(pictures), "--width", "400"]
    calls = kill_at_the_third(monkeypatch)
    drawn = []
    draw_sample = infer.draw
    monkeypatch.setattr(infer, "draw", lambda *args: drawn.append(args) or draw_sample(*args))
    with pytest.raises(KeyboardInterrupt):
        infer.main([*words, *draw] if drawn_before else words)
    infer.main([*words, *draw])
    assert len(list(pictures.glob("*.png"))) == 4
    assert len(calls) == 5  # three, and the two whose results were not there
    assert len(drawn) == (5 if drawn_before else 4)


def test_a_run_whose_config_has_changed_begins_anew(drive, model, tmp_path, monkeypatch, capsys):
    """The settings may come from a base file of the config that the command names."""
    base = tmp_path / "base.py"
    base.write_text(f"_base_ = {str(Path(model[0]).resolve())!r}\n")
    own = tmp_path / "own.py"
    own.write_text(f"_base_ = {str(base)!r}\n")
    words = [str(drive), "--model", str(own), *model[1:], "--out", str(tmp_path / "map.json")]
    calls = kill_at_the_third(monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        infer.main(words)
    with base.open("a") as file:
        file.write("model = dict(map_head=dict(coder=dict(max_num=3)))\n")
    infer.main(words)
    assert "going on" not in capsys.readouterr().out
    assert len(calls) == 7  # three, and all four again
    assert {len(vectors) for vectors in results(tmp_path / "map.json").values()} == {3}
    # Shards with one config and with the other do not belong together.
    parts = ["--out", str(tmp_path / "parts.json"), "--shard"]
    infer.main([*words[:-2], *parts, "0/2"])
    with base.open("a") as file:  # a setting of the data
        file.write("test_dataloader = dict(dataset=dict(pose_only_signals=True))\n")
    infer.main([*words[:-2], *parts, "1/2"])
    with pytest.raises(ValueError, match="differs in config"):
        merge([str(tmp_path / "parts.json")])


def test_memory_sees_the_frames_before_after_a_kill_too(
    drive, tiny_config, tmp_path, capsys, monkeypatch
):
    config, weights = tmp_path / "remembers.py", tmp_path / "weights.pth"
    temporal = "dict(bev=dict(), queries=dict(num=2), embed_dims=16)"
    config.write_text(f"_base_ = {str(tiny_config)!r}\nmodel = dict(temporal={temporal})\n")
    torch.manual_seed(0)
    torch.save({"state_dict": MODELS.build(read_config(config).model).state_dict()}, weights)
    words = [str(drive), "--model", str(config), str(weights), "--out"]
    infer.main([*words, str(tmp_path / "whole.json")])
    calls = kill_at_the_third(monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        infer.main([*words, str(tmp_path / "killed.json")])
    infer.main([*words, str(tmp_path / "killed.json")])
    assert "going on after 2 of 4 samples" in capsys.readouterr().out
    assert len(calls) == 5  # three, and the two that were not there
    assert results(tmp_path / "killed.json") == results(tmp_path / "whole.json")
    with pytest.raises(ValueError, match="--shard cuts drives, which a model that uses earlier"):
        infer.main([*words, str(tmp_path / "part.json"), "--shard", "1/2"])


def test_other_settings_start_anew(drive, model, tmp_path, capsys):
    out = tmp_path / "map.json"
    lines = ['{"other": 1}', '{"sample_token": "x", "vectors": []}']
    (tmp_path / "map.json.unfinished").write_text("\n".join([*lines, ""]))
    infer.main([str(drive), "--model", *model, "--out", str(out), "--max-samples", "1"])
    assert "going on" not in capsys.readouterr().out
    assert len(results(out)) == 1


def test_nothing_is_written_over_samples_of_another_origin_nor_through_a_link(
    drive, model, minicity_annotations, tmp_path, capsys
):
    words = [str(drive), "--model", *model, "--max-samples", "1", "--out"]
    samples, content = tmp_path / "map.arrow", minicity_annotations["val"].read_bytes()
    samples.write_bytes(content)
    with pytest.raises(ValueError, match=r"map.arrow is there, and not from an earlier run"):
        infer.main([*words, str(tmp_path / "map.json")])
    assert samples.read_bytes() == content
    samples.unlink()
    for _ in range(2):  # its own may be replaced
        infer.main([*words, str(tmp_path / "map.json")])
    with pytest.raises(SystemExit):
        infer.main([*words, str(samples)])
    assert "--out names a JSON file" in capsys.readouterr().err
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "other_frames").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ValueError, match="other_frames is a link"):
        infer.main([*words, str(tmp_path / "other.json")])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--model", "a", "b", "c", "--out", "x.json"], "--model takes a name, or a config"),
        (["--out", "x.json"], "the following arguments are required: --model"),
    ],
)
def test_wrong_words_are_named(drive, words, message, capsys):
    with pytest.raises(SystemExit):
        infer.main(["--", str(drive)] if not words else [str(drive), *words])
    assert message in capsys.readouterr().err


def test_nothing_to_do_and_no_usable_frame_are_named(drive, model, tmp_path):
    with pytest.raises(ValueError, match="Nothing to do"):
        infer.main([str(drive), "--model", *model])
    (tmp_path / "drive/samples").unlink()
    with pytest.raises(ValueError, match=r"no frame can be used: sample .* no image at"):
        infer.main([str(drive), "--model", *model, "--out", str(tmp_path / "m.json")])


def test_a_bag_with_one_bad_image_loses_one_frame(
    model, minicity_root, minicity_annotations, tmp_path, capsys
):
    first, *others = AnnotationFile(minicity_annotations["val"])
    (tmp_path / "bad.jpg").write_bytes(b"")
    bad = replace(first.cameras[0], path=str(tmp_path / "bad.jpg"))
    recorder = Recorder(tmp_path / "drive", "sqlite")
    record(recorder, [replace(first, cameras=[bad, *first.cameras[1:]]), *others], minicity_root)
    words = [str(recorder.path), "--out", str(tmp_path / "map.json"), "--rate", "all"]
    with pytest.raises(SystemExit) as end:
        infer.main([*words, "--vehicle-ground-z", str(-AXLE_M), "--model", *model])
    assert end.value.code == infer.SKIPPED
    printed = capsys.readouterr().out
    time_ns = first.timestamp_ns
    assert f"camera '{bad.name}', image at {time_ns} ns: its message is not an image" in printed
    assert f"1 broken frames skipped: drive_{time_ns}\n" in printed
    assert len(results(tmp_path / "map.json")) == len(others)


def test_results_name_the_model_and_the_scenes_of_data_and_training(model, tmp_path):
    path, near = tmp_path / "calibrated.pth", "near@" + "0" * 16
    calibration = {"law": "laplace", "sigmas": 1.0}
    trained = {"dataset": "nuscenes", "split_list": near}
    meta = {"dataset_meta": trained, "calibration": calibration}
    torch.save({**torch.load(model[1], weights_only=True), "meta": meta}, path)
    args = SimpleNamespace(model=[model[0], str(path)])
    data = {"classes": ("divider",), "dataset": "nuscenes", "split_list": "official"}
    about = {"classes": ["divider"], "checkpoint": digest(path), "calibration": calibration}
    assert infer.result_header(args, {"classes": ("divider",)}) == about
    listed = {**about, "split_list": "official"}
    assert infer.result_header(args, data) == {**listed, "trained_on": near}
    assert infer.result_header(args, {**data, "dataset": "minicity"}) == listed
    plain = infer.result_header(SimpleNamespace(model=model), {"classes": ("divider",)})
    assert plain == {"classes": ["divider"], "checkpoint": digest(Path(model[1]))}
