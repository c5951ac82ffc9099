"""Splits by place: published lists, our own splitter, and what validation shares with training."""

import argparse
import hashlib
import json
import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from argoverse2_road import write_log
from nuscenes.utils.splits import create_splits_scenes
from sample_cases import META, pose, sample

from gsmap.datasets.annotations.file import AnnotationFile, write_annotations
from gsmap.datasets.annotations.record import AnnotationMeta
from gsmap.utils.split_lists import checked_identity, list_identity, require_same_list
from mapdata import overlap, splits, splitter
from mapdata.argoverse2.convert import convert_argoverse2
from mapdata.argoverse2.samples import Argoverse2Options
from mapdata.nuscenes.convert import NuScenesOptions, convert_nuscenes
from mapdata.splits import SplitList, published_split, split_names

SIZES = {
    ("nuscenes", "streammapnet"): (694, 148),  # of 698, four are left out as by its converter
    ("nuscenes", "lilja-near"): (657, 124, 137),
    ("nuscenes", "lilja-far-a"): (753, 247),
    ("nuscenes", "lilja-far-b"): (797, 203),
    ("av2", "streammapnet"): (746, 149),  # of 749, three likewise
    ("av2", "lilja-near"): (696, 151, 151),
    ("av2", "lilja-far-a"): (704, 294),
    ("av2", "lilja-far-b"): (648, 350),
    ("av2", "lilja-far-c"): (644, 354),
}
GOLDEN = {"nuscenes": "nuscenes", "av2": "argoverse2"}


@pytest.mark.parametrize(("dataset", "name"), SIZES)
def test_published_splits_are_those_of_their_sources(dataset: str, name: str, golden_dir: Path):
    found = published_split(name, dataset)
    assert tuple(map(len, found.scenes.values())) == SIZES[dataset, name]
    family, *fold = name.removeprefix("lilja-").split("-")
    middle = "streammapnet_newsplit" if family == "streammapnet" else f"lilja_{family}"
    file = "_".join([GOLDEN[dataset], middle, *(letter.upper() for letter in fold)])
    wanted = json.loads((golden_dir / f"splits/{file}.json").read_text())
    left_out = set(wanted.get("dropped_by_converter", ()))
    for part, scenes in found.scenes.items():
        assert sorted(scenes) == sorted(set(wanted[part]) - left_out)
    every = Counter(scene for scenes in found.scenes.values() for scene in scenes)
    assert every.most_common(1)[0][1] == 1


def test_every_published_split_has_a_test():
    assert {(d, n) for d in ("nuscenes", "av2") for n in split_names(d)} == set(SIZES)
    with pytest.raises(ValueError, match=r"no split 'far' of av2: name one of streammapnet, lilja"):
        published_split("far", "av2")


def test_the_identity_is_name_and_digest_whatever_the_order():
    one = SplitList("a", {"train": ["x", "y"], "val": ["z"]}).identity
    assert one == list_identity("a", {"val": ("z",), "train": {"y", "x"}})
    plain = '{"train": ["x", "y"], "val": ["z"]}'
    assert one == "a@" + hashlib.sha256(plain.encode()).hexdigest()[:16]
    assert one != SplitList("a", {"train": ["x"], "val": ["z", "y"]}).identity


@pytest.mark.parametrize("text", ["a b", "a@12", "../x", "a@" + "g" * 16, 5, ["a"], "\n", "a\n"])
def test_an_identity_that_a_file_brings_is_checked(text):
    with pytest.raises(ValueError, match="split_list must be a name with a digest"):
        checked_identity(text)
    with pytest.raises(ValueError, match="split_list must be a name with a digest"):
        AnnotationMeta("nuscenes", "lidar", "val", options={"split_list": text})


def test_other_lists_are_refused_and_unknown_ones_are_not():
    require_same_list("", "official", "m", "x")
    require_same_list("official", None, "m", "x")
    require_same_list("official", "official", "m", "x")
    with pytest.raises(
        ValueError, match=r"^model was trained on the split near, .* with --flag\.$"
    ):
        require_same_list("near", "official", "model", "--flag")


def write_versions(root: Path, damaged_root: Path) -> list[str]:
    """Divide MiniCity's scenes among two versions, as official test scenes are; their names."""
    scenes = json.loads((damaged_root / "v1.0-trainval/scene.json").read_text())
    shutil.copytree(damaged_root, root)
    shutil.copytree(root / "v1.0-trainval", root / "v1.0-test")
    for version, part in (("v1.0-trainval", scenes[:-1]), ("v1.0-test", scenes[-1:])):
        (root / version / "scene.json").write_text(json.dumps(part))
    return [scene["name"] for scene in scenes]


@pytest.fixture
def mixed(damaged_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A published split whose validation holds the one official test scene."""
    names = write_versions(tmp_path / "mixed", damaged_root)
    wanted = SplitList("near", {"train": names[:-1], "val": names[-1:]}, complete=True)
    monkeypatch.setattr(splits, "published_split", lambda name, dataset: wanted)
    return NuScenesOptions(tmp_path / "mixed", "v1.0-trainval", split_name="near"), wanted


def test_a_published_split_takes_scenes_of_several_versions(mixed):
    options, wanted = mixed
    with pytest.raises(ValueError, match=r"'near': only \d of the \d scenes .* --allow-missing"):
        convert_nuscenes(options)
    convert_nuscenes(replace(options, version=("v1.0-trainval", "v1.0-test")))
    for part, names in wanted.scenes.items():
        file = AnnotationFile(options.root / f"gsmap_nuscenes_{part}_near.arrow")
        assert {s.scene for s in file} == set(names)
        assert file.meta.split_list == wanted.identity
    summary = convert_nuscenes(replace(options, allow_missing=True, tag="_some"))
    assert "scenes of the splits are in" in summary.text()


def test_official_splits_have_one_identity_and_own_ones_that_of_their_file(
    damaged_root: Path, tmp_path: Path
):
    write_versions(tmp_path / "mixed", damaged_root)
    scenes = json.loads((tmp_path / "mixed/v1.0-trainval/scene.json").read_text())
    for scene, name in zip(scenes, ("scene-0061", "scene-0103"), strict=False):  # of mini, too
        scene["name"] = name
    (tmp_path / "mixed/v1.0-mini").symlink_to("v1.0-trainval")
    (tmp_path / "mixed/v1.0-trainval/scene.json").write_text(json.dumps(scenes))
    found = []
    for version, split in (("v1.0-trainval", "train"), ("v1.0-mini", "mini_train")):
        convert_nuscenes(NuScenesOptions(tmp_path / "mixed", version))
        file = AnnotationFile(tmp_path / f"mixed/gsmap_nuscenes_{split}.arrow")
        found.append(file.meta.split_list)
    assert found[0] == found[1]
    assert found[0].startswith("official@")


def test_each_of_several_versions_has_a_list(damaged_root: Path, tmp_path: Path):
    root = tmp_path / "mixed"
    *names, last = write_versions(root, damaged_root)
    lists = {"v1.0-trainval": {"train": names}, "v1.0-test": {"train": [], "val": [last]}}
    for version, parts in lists.items():
        (root / version / "splits.json").write_text(json.dumps(parts))
    options = NuScenesOptions(root, ("v1.0-trainval", "v1.0-test"))
    convert_nuscenes(options)
    for part, wanted in (("train", set(names)), ("val", {last})):
        file = AnnotationFile(root / f"gsmap_nuscenes_{part}.arrow")
        assert {s.scene for s in file} == wanted
        assert file.meta.split_list == ""
    # A list may give scenes of the official list to another part.
    official = create_splits_scenes()["test"][0]
    lists["v1.0-trainval"]["val"] = [official]
    (root / "v1.0-trainval/splits.json").write_text(json.dumps(lists["v1.0-trainval"]))
    (root / "v1.0-test/splits.json").unlink()  # the official list has other scenes
    text = convert_nuscenes(options).text()
    assert f"{len(names)} of the {len(names) + 150} scenes" in text
    assert f"in no part of the splits, such as '{last}'" in text
    (root / "v1.0-test").rename(root / "own")
    with pytest.raises(ValueError, match=r"'own' has no official splits: .*own/splits\.json"):
        convert_nuscenes(replace(options, version=("v1.0-trainval", "own")))


def test_an_older_file_has_no_list_and_is_read(tmp_path: Path):
    write_annotations(tmp_path / "old.arrow", META, [sample()])
    assert AnnotationFile(tmp_path / "old.arrow").meta.split_list == ""


def test_logs_of_a_list_come_from_all_official_folders(tmp_path: Path):
    for folder, name in (("train", "log-a"), ("val", "log-b"), ("test", "log-c")):
        write_log(tmp_path / folder / name)
    own = tmp_path / "own.json"
    own.write_text(json.dumps({"train": ["log-b"], "val": ["log-c", "log-a", "log-x"]}))
    options = Argoverse2Options(tmp_path, split_file=own, workers=1, tag="_own", rate_hz=2.0)
    summary = convert_argoverse2(options)
    assert "2 of the 3 scenes of the splits are in" in summary.text()
    file = AnnotationFile(tmp_path / "gsmap_av2_val_own.arrow")
    assert {s.scene for s in file} == {"log-a", "log-c"}
    assert file.meta.split_list.startswith("own@")
    with pytest.raises(ValueError, match="split 'own' has no part 'test'"):
        convert_argoverse2(replace(options, split="test"))
    write_log(tmp_path / "sensor" / "val" / "log-a")  # not read, because there is a folder val
    write_log(tmp_path / "val" / "log-a")
    with pytest.raises(ValueError, match=r"train/log-a and .*val/log-a are one log: remove one"):
        convert_argoverse2(options)
    shutil.rmtree(tmp_path / "val" / "log-a")
    own.write_text(json.dumps({"train": ["log-a"], "val": ["log-a"]}))
    with pytest.raises(ValueError, match="log-a is in both train and val; list each log"):
        convert_argoverse2(options)


def write_scenes(path: Path, places: dict[str, tuple[str, list[tuple[float, float]]]]) -> Path:
    """Write an annotation file of scenes on maps, each with the (x, y) of its samples."""
    samples = []
    for scene, (town, positions) in places.items():
        for number, (x, y) in enumerate(positions):
            at = pose(0)
            at[:2, 3] = x, y
            token = f"{scene}-{number}"
            changes = {"scene": scene, "map_name": town, "global_from_frame": at, "token": token}
            samples.append(sample(number, **changes))
    write_annotations(path, META, samples)
    return path


def parsed(module, *words: object) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    module.add_arguments(parser)
    return parser.parse_args([str(word) for word in words])


def test_overlap_is_reported_for_each_sample_and_drawn(tmp_path: Path):
    """Training at x = 0 and 100 of town a; validation 3 m and 20 m away, and in a town apart."""
    train = write_scenes(tmp_path / "train.arrow", {"t": ("a", [(0, 0), (100, 0)])})
    places = {"v": ("a", [(0, 3), (100, 20)]), "w": ("b", [(0, 0)])}
    val = write_scenes(tmp_path / "val.arrow", places)
    text = overlap.run(
        parsed(overlap, train, val, "--out", tmp_path / "o.json", "--plot", tmp_path / "o.png")
    )
    assert "33.3% within 5 m" in text
    assert "66.7% within 30 m" in text
    assert "50.0% of 2 within 5 m on map 'a'" in text
    found = {entry["token"]: entry for entry in json.loads((tmp_path / "o.json").read_text())}
    assert [found[t]["distance_m"] for t in ("v-0", "v-1", "w-0")] == [3, 20, None]
    assert [found[t]["nearest"] for t in ("v-0", "v-1", "w-0")] == ["t-0", "t-1", None]
    assert (tmp_path / "o.png").stat().st_size > 1000


def test_a_file_without_common_maps_is_refused(tmp_path: Path):
    for places in ({"log": ("log", [(0, 0)])}, {"a": ("t", [(0, 0)]), "b": ("", [(0, 0)])}):
        path = write_scenes(tmp_path / "infos.arrow", places)
        with pytest.raises(ValueError, match="does not say where its samples are"):
            overlap.read_places([path])


def row_of_scenes(count: int, spacing_m: float) -> dict:
    """Scenes one after another along x, each of two samples 10 m apart; two towns."""
    return {
        f"{town}{i}": (town, [(i * spacing_m, 0.0), (i * spacing_m + 10, 0.0)])
        for town in ("a", "b")
        for i in range(count)
    }


@pytest.mark.parametrize("seed", range(4))
def test_our_splitter_keeps_the_distance_and_gives_each_map_its_share(tmp_path: Path, seed: int):
    path = write_scenes(tmp_path / "all.arrow", row_of_scenes(10, 30.0))
    places = overlap.read_places([path])
    parts = splitter.split_scenes(places, 25.0, 0.3, seed)
    assert Counter(name[0] for name in parts["val"]) == {"a": 3, "b": 3}
    position = {name: int(name[1:]) for name in (*parts["train"], *parts["val"])}
    for name in parts["val"]:
        same = [position[t] for t in parts["train"] if t[0] == name[0]]
        assert min(abs(position[name] - other) for other in same) > 1  # 20 m to the neighbour
    # a run of neighbours costs two others at most
    assert len(parts["train"]) >= 2 * (10 - 3 - 2)
    assert parts == splitter.split_scenes(places, 25.0, 0.3, seed)


@pytest.mark.parametrize("seed", range(8))
def test_a_scene_on_two_maps_is_in_one_part_and_far_from_the_other_on_both(seed: int):
    """Of each town, the first two scenes leave for the other one, where they are near a scene."""
    rows = []  # scene, town, x
    for town, other in (("a", "b"), ("b", "a")):
        for i in range(10):
            rows.append((f"{town}{i}", town, 100.0 * i))
        for i in range(2):
            rows.append((f"{town}{i}", other, 100.0 * (5 + i) + 10))
    scenes, towns, x = map(np.array, zip(*rows, strict=True))
    places = overlap.Places(scenes, scenes, towns, np.stack([x, 0 * x], axis=1))
    parts = splitter.split_scenes(places, min_distance_m=20.0, val_share=0.3, seed=seed)
    assert not set(parts["train"]) & set(parts["val"])
    train, val = (places.select(np.isin(scenes, parts[part])) for part in ("train", "val"))
    distance, _ = overlap.sample_overlap(train, val)
    assert distance.min() > 20.0


def test_seeds_differ_and_impossible_splits_are_refused(tmp_path: Path):
    path = write_scenes(tmp_path / "all.arrow", row_of_scenes(10, 30.0))
    places = overlap.read_places([path])
    found = {tuple(splitter.split_scenes(places, 25.0, 0.3, seed)["val"]) for seed in range(6)}
    assert len(found) > 1
    with pytest.raises(ValueError, match="give a smaller --min-distance"):
        splitter.split_scenes(places, 1e4, 0.3, 0)
    with pytest.raises(ValueError, match="must be in"):
        splitter.split_scenes(places, 25.0, 1.5, 0)


def test_the_command_writes_a_split_file_that_the_converters_read(tmp_path: Path):
    path = write_scenes(tmp_path / "all.arrow", row_of_scenes(10, 30.0))
    out = tmp_path / "own.json"
    words = "--min-distance", 25, "--val-share", 0.2
    text = splitter.run(parsed(splitter, path, "--out", out, *words))
    parts = splits.read_split_file(out).scenes
    assert f"val {len(parts['val'])} scenes" in text
    assert "the nearest samples are 50.0 m apart" in text
    assert not set(parts["train"]) & set(parts["val"])
    assert np.all([name in row_of_scenes(10, 1) for name in parts["train"]])
