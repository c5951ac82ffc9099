"""The command on a drive whose ground truth is fed as predictions."""

import json
import os
import re
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from drive_cases import CLASSES, drive_of

from gsmap.datasets.annotations.file import AnnotationFile, write_annotations
from gsmap.datasets.annotations.record import AnnotationMeta, MapInstance
from gsmap.datasets.elements import elements_of_instances
from gsmap.evaluation.core.results_json import vectors_of, write_results
from tools.build_map import main


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Results and annotation file of the same samples."""
    folder, samples, results = tmp_path_factory.mktemp("drive"), [], []
    for frame in drive_of().frames:
        rows = zip(frame.elements.polylines, frame.elements.labels, strict=True)
        instances = [MapInstance(int(k), frame.to_frame(line)) for line, k in rows]
        samples.append(replace(frame.sample, instances=instances))
        vectors = vectors_of(elements_of_instances(instances), CLASSES)
        results.append((frame.sample.token, vectors))
    ann = folder / "annotations.arrow"
    write_annotations(ann, AnnotationMeta("own", "lidar", "val"), samples)
    write_results(folder / "results.json", results)
    return folder / "results.json", ann


def test_ground_truth_as_predictions_scores_1(files, tmp_path, capsys):
    results, ann = files
    formats = ["--formats", "geojson", "png"]
    report = main([str(results), "--ann", str(ann), "--out", str(tmp_path), *formats])
    assert re.fullmatch(r"1 drive, \d+ frames, merged in \d\.\d s of processor time", report)
    scores = json.loads((tmp_path / "scores.json").read_text())
    assert scores["merged"]["AP"]["mean"] == pytest.approx(1.0)
    assert scores["merged"]["completeness@0.5"]["mean"] > 0.99
    assert scores["merged"]["accuracy@0.5"]["mean"] > 0.99
    assert len(json.loads((tmp_path / "scene.geojson").read_text())["features"]) == 6
    assert "| AP | suppressed |" in capsys.readouterr().out
    picture = cv2.imread(str(tmp_path / "scene.png"))
    assert picture.shape[1] == 1500
    orange = np.abs(picture[..., ::-1].astype(int) - [255, 149, 0]).max(axis=-1) < 4
    assert orange.mean() > 1e-3  # the dividers, in the colour of all pictures


def test_maps_of_a_model_of_another_split_are_not_scored_unless_allowed(files, tmp_path):
    results, ann = files
    here, other = ("near@" + digit * 16 for digit in "01")
    content = json.loads(results.read_text())
    (tmp_path / "r.json").write_text(json.dumps({**content, "meta": {"trained_on": other}}))
    samples = list(AnnotationFile(ann))
    words = [str(tmp_path / "r.json"), "--ann", str(tmp_path / "a.arrow"), "--out", str(tmp_path)]
    for truth in (False, True):
        split = "val" if truth else "test"
        meta = AnnotationMeta("own", "lidar", split, options={"split_list": here})
        found = samples if truth else [replace(sample, instances=None) for sample in samples]
        write_annotations(tmp_path / "a.arrow", meta, found)
        if truth:
            with pytest.raises(ValueError, match=f"r.json was trained on the split {other}"):
                main(words)
            words.append("--allow-other-split")
        main(words)
    assert (tmp_path / "scores.json").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--scene", "elsewhere"], "has no scene 'elsewhere'"),
        (["--formats", "osm"], "give --origin LAT LON"),
        (["--formats", "osm", "--origin", "100", "0"], "latitude within 90"),
    ],
)
def test_what_a_user_can_get_wrong_is_said(files, tmp_path, options, message):
    results, ann = files
    with pytest.raises(ValueError, match=message):
        main([str(results), "--ann", str(ann), "--out", str(tmp_path), *options])


@pytest.mark.parametrize(
    ("package", "options"),
    [("rerun", ["geojson", "rrd"]), ("pyproj", ["geojson", "--origin", "48", "11"])],
)
def test_a_missing_package_is_said_before_anything_is_written(
    files, tmp_path, monkeypatch, package, options
):
    monkeypatch.setitem(sys.modules, package, None)
    results, ann = files
    words = [str(results), "--ann", str(ann), "--out", str(tmp_path / "maps")]
    with pytest.raises(RuntimeError, match=f"{package} is not installed: `pip install"):
        main([*words, "--formats", *options])
    assert not (tmp_path / "maps").exists()


def test_samples_without_poses_have_no_map_but_a_film(files, tmp_path):
    results, ann = files
    samples = [replace(s, instances=None, global_from_frame=np.eye(4)) for s in AnnotationFile(ann)]
    meta = AnnotationMeta("own", "lidar", "test", options={"poses": False})
    write_annotations(tmp_path / "own.arrow", meta, samples[:2])
    words = [str(results), "--ann", str(tmp_path / "own.arrow"), "--out", str(tmp_path)]
    with pytest.raises(ValueError, match=r"have no poses, .*--formats mp4"):
        main(words)
    main([*words, "--formats", "mp4"])
    assert (tmp_path / "scene.mp4").stat().st_size > 10_000


def test_results_of_other_samples_are_refused(files, tmp_path):
    write_results(tmp_path / "other.json", [("somewhere", [])])
    with pytest.raises(ValueError, match=r"no sample of scene 'scene' has results"):
        main([str(tmp_path / "other.json"), "--ann", str(files[1]), "--out", str(tmp_path)])


ALL_FORMATS = ("geojson", "osm", "mcap", "mp4", "png", "svg")
STRANGERS = (b"", b"{}", b'{"type": "FeatureCollection", "features": []}', b"x" * 300_000)


@pytest.mark.parametrize(
    "name", ["scene.geojson", "scene_lonlat.geojson", "scene.osm", "scores.json"]
)
@pytest.mark.parametrize("content", STRANGERS, ids=["empty", "object", "geojson", "large"])
def test_no_file_of_another_program_is_replaced(files, tmp_path, name, content):
    results, ann = files
    (tmp_path / name).write_bytes(content)
    words = [str(results), "--ann", str(ann), "--out", str(tmp_path), "--origin", "48", "11"]
    with pytest.raises(ValueError, match=rf"{name} is there, and no file of this command"):
        main([*words, "--formats", "geojson", "osm"])
    assert (tmp_path / name).read_bytes() == content
    assert os.listdir(tmp_path) == [name]


def test_files_of_earlier_runs_and_links_are_replaced(files, tmp_path):
    results, ann = files
    words = [str(results), "--ann", str(ann), "--out", str(tmp_path / "maps")]
    words += ["--formats", *ALL_FORMATS, "--origin", "48", "11"]
    main(words)
    names = set(os.listdir(tmp_path / "maps"))
    assert names == {
        *(f"scene.{kind}" for kind in ALL_FORMATS),
        "scene_lonlat.geojson",
        "scores.json",
    }
    (tmp_path / "precious").write_text("keep me")
    (tmp_path / "maps/scene.osm").unlink()
    (tmp_path / "maps/scene.osm").symlink_to(tmp_path / "precious")
    for name in names - {"scene.osm"}:
        os.utime(tmp_path / "maps" / name, (0, 0))
    main(words)
    assert (tmp_path / "precious").read_text() == "keep me"
    for name in names:
        assert (tmp_path / "maps" / name).lstat().st_mtime > 0
        assert not (tmp_path / "maps" / name).is_symlink()


def test_a_folder_or_a_pipe_under_the_name_of_a_map_is_refused(files, tmp_path):
    results, ann = files
    words = [str(results), "--ann", str(ann), "--out", str(tmp_path)]
    for make in (Path.mkdir, os.mkfifo):
        make(tmp_path / "scene.geojson")
        with pytest.raises(ValueError, match=r"scene\.geojson is there, and no file"):
            main(words)
        os.rename(tmp_path / "scene.geojson", tmp_path / make.__name__)
