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
import shapely
import torch
from drive_cases import CLASSES, curve, drive_of, street

from drivemaps.geodetic import MapGrid
from gsmap.datasets.annotations.file import AnnotationFile, write_annotations
from gsmap.datasets.annotations.record import AnnotationMeta, MapInstance
from gsmap.datasets.elements import elements_of_instances
from gsmap.evaluation.core.results_json import vectors_of, write_results
from gsmap.prior import MapPrior, PriorSettings, open_prior
from gsmap.structures.grid import BEVGrid
from gsmap.structures.rigid import rigid
from tools.build_map import main, require_positions


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


def test_a_grid_without_its_file_of_corrections_is_named(capsys, monkeypatch):
    pytest.importorskip("pyproj", reason="pip install -e .[maps]")
    sample = drive_of().frames[0].sample
    pose = rigid(np.eye(3), np.array([651_409.8, 313_177.5, 0]))
    samples = [replace(sample, global_from_frame=pose)]
    monkeypatch.setattr(MapGrid, "accuracy_warning", lambda *_: "only accurate to 2 m")
    require_positions(samples, [MapGrid("EPSG:27700")], "a")
    assert capsys.readouterr().out == "warning: only accurate to 2 m\n"
    monkeypatch.setattr(MapGrid, "accuracy_warning", lambda *_: None)
    require_positions(samples, [MapGrid("EPSG:27700"), None], "a")
    assert capsys.readouterr().out == ""


def test_poses_that_cannot_be_right_are_named(files, tmp_path, capsys):
    results, ann = files

    def exchange(pose):
        return rigid(pose[:3, :3], pose[[1, 0, 2], 3])

    for name, change in (("right", np.asarray), ("wrong", exchange)):
        path = tmp_path / f"{name}.arrow"
        file = AnnotationFile(ann)
        samples = [replace(s, global_from_frame=change(s.global_from_frame)) for s in file]
        write_annotations(path, file.meta, samples)
        main([str(results), "--ann", str(path), "--out", str(tmp_path / name)])
        is_named = "degrees sideways" in capsys.readouterr().out
        assert is_named == (name == "wrong")


def test_scores_of_an_empty_map_are_json_without_nan(files, tmp_path, capsys):
    _, ann = files
    nothing = [(token, []) for token in AnnotationFile(ann).column("token")]
    write_results(tmp_path / "empty.json", nothing)
    main([str(tmp_path / "empty.json"), "--ann", str(ann), "--out", str(tmp_path)])
    text = (tmp_path / "scores.json").read_text()
    scores = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} in {text}"))
    assert scores["merged"]["AP"]["mean"] == 0
    assert "mean" not in scores["merged"]["accuracy@0.5"]
    assert "| accuracy@0.5 | merged | - |" in capsys.readouterr().out


def test_predictions_of_other_classes_are_left_out_and_counted(files, tmp_path, capsys):
    results, ann = files
    content = json.loads(results.read_text())
    for sample in content["results"]:
        sample["vectors"].append({**sample["vectors"][0], "cls_name": "kerb"})
    content["results"].append({"sample_token": "elsewhere", "vectors": []})
    short = {"cls_name": CLASSES[0], "pts": [[0, 0]], "confidence_level": 0.9}
    content["results"][0]["vectors"].append(short)
    (tmp_path / "more.json").write_text(json.dumps(content))
    for name, given in (("plain", results), ("more", tmp_path / "more.json")):
        main([str(given), "--ann", str(ann), "--out", str(tmp_path / name)])
        text = capsys.readouterr().out
        for note in (
            f"not used: {len(content['results']) - 1} predictions of class 'kerb'\n",
            "not used: 1 prediction of fewer than two points\n",
            f"not used: 1 result of samples that {ann} lacks, such as 'elsewhere'\n",
        ):
            assert (note in text) == (name == "more")
    for name in ("scores.json", "scene.geojson"):
        assert (tmp_path / "plain" / name).read_bytes() == (tmp_path / "more" / name).read_bytes()
    prior = ["--prior", str(tmp_path / "street.gsmap-prior"), "--gaussians"]
    main([str(tmp_path / "more.json"), "--ann", str(ann), *prior])


def test_samples_without_results_are_left_out_and_counted(files, tmp_path, capsys):
    content = json.loads(files[0].read_text())
    gone = content["results"].pop(3)["sample_token"]
    (tmp_path / "fewer.json").write_text(json.dumps(content))
    main([str(tmp_path / "fewer.json"), "--ann", str(files[1]), "--out", str(tmp_path)])
    said = f"not used: 1 sample without results, such as {gone!r}\n"
    assert said in capsys.readouterr().out


def test_drives_without_results_are_left_out_and_counted_or_refused(files, tmp_path, capsys):
    results, ann = files
    file = AnnotationFile(ann)
    first, *others = file
    far = replace(first, scene="away", map_name="other")
    content = json.loads(results.read_text())
    content["results"] = [r for r in content["results"] if r["sample_token"] != first.token]
    (tmp_path / "fewer.json").write_text(json.dumps(content))
    write_annotations(tmp_path / "two.arrow", file.meta, [far, *others])
    command = [str(tmp_path / "fewer.json"), "--ann", str(tmp_path / "two.arrow")]
    prior = ["--prior", str(tmp_path / "street.prior")]  # of one place: "away" is not in it
    main([*command, "--out", str(tmp_path / "maps"), *prior])
    assert "not used: 1 drive without results, such as 'away'\n" in capsys.readouterr().out
    assert [path.name for path in (tmp_path / "maps").glob("*.geojson")] == ["scene.geojson"]
    named = [*command, "--out", str(tmp_path / "named"), "--scene", "scene", "away"]
    with pytest.raises(ValueError, match=r"no sample of scene 'away' has results.* --scene"):
        main(named)
    assert not (tmp_path / "named").exists()


def test_drives_of_a_place_are_joined_into_one_map(files, tmp_path, capsys):
    results, ann = files
    file = AnnotationFile(ann)
    samples = list(file)
    half = len(samples) // 2
    samples[half:] = [replace(sample, scene="later") for sample in samples[half:]]
    samples[-1] = replace(samples[-1], scene="away", map_name="other")
    two_drives = tmp_path / "two.arrow"
    write_annotations(two_drives, file.meta, samples)
    command = [str(results), "--ann", str(two_drives), "--out", str(tmp_path / "maps"), "--join"]
    report = main(command)
    assert report.startswith(f"3 drives, {len(samples)} frames")
    repeated = main([*command, "--scene", "scene", "later", "away", "scene"])
    assert repeated.startswith(f"3 drives, {len(samples)} frames")
    names = sorted(path.name for path in (tmp_path / "maps").glob("*.geojson"))
    assert names == sorted(f"{samples[row].map_name}.geojson" for row in (0, -1))
    joined = json.loads((tmp_path / "maps" / f"{samples[0].map_name}.geojson").read_text())
    assert len(joined["features"]) == 6  # one drive alone sees a part of them
    scores = json.loads((tmp_path / "maps" / "scores.json").read_text())
    assert scores["merged"]["AP"]["mean"] > 0.95
    samples[0] = replace(samples[0], scene="unknown", map_name="")
    write_annotations(two_drives, file.meta, samples)
    with pytest.raises(ValueError, match="'unknown' has no map_name: leave --join out"):
        main(command)
    with pytest.raises(SystemExit):
        main([*command, "--changes", str(tmp_path / "old.geojson")])
    assert "leave --join out" in capsys.readouterr().err


def test_a_scene_of_two_places_is_refused_before_anything_is_written(files, tmp_path):
    results, ann = files
    file = AnnotationFile(ann)
    samples = list(file)
    samples[0] = replace(samples[0], scene="later")
    samples[5] = replace(samples[5], map_name="vienna")  # a second drive of the name "scene"
    samples[6] = replace(samples[6], map_name="")  # unknown, which is no second place
    write_annotations(tmp_path / "two.arrow", file.meta, samples)
    command = [str(results), "--ann", str(tmp_path / "two.arrow"), "--out", str(tmp_path / "maps")]
    message = r"scene 'scene' lie in several places, \['town', 'vienna'\] \(map_name\)"
    for options in ([], ["--join"], ["--scene", "later", "scene"], ["--formats", "png"]):
        with pytest.raises(ValueError, match=message):
            main([*command, *options])
    assert not (tmp_path / "maps").exists()
    main([*command, "--scene", "later"])  # a drive of the file that lies in one place
    assert set(os.listdir(tmp_path / "maps")) == {"later.geojson", "scores.json"}
    samples[5] = replace(samples[5], scene="vienna1")
    write_annotations(tmp_path / "two.arrow", file.meta, samples)
    main([*command, "--join", "--scene", "scene", "vienna1"])
    assert {"town.geojson", "vienna.geojson"} <= set(os.listdir(tmp_path / "maps"))


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
    with pytest.raises(ValueError, match=r"no sample of scene 'scene' has results.* --scene"):
        main([str(tmp_path / "other.json"), "--ann", str(files[1]), "--out", str(tmp_path)])


def test_places_on_one_grid_are_named_with_their_latitude_and_longitude(files, tmp_path, capsys):
    pytest.importorskip("pyproj", reason="pip install -e .[maps]")
    results, ann = files
    file = AnnotationFile(ann)
    first, *others = file

    def at(sample, scene, place, x, y):
        pose = sample.global_from_frame
        moved = rigid(pose[:3, :3], pose[:3, 3] + np.array([x, y, 0.0]))
        return replace(sample, scene=scene, map_name=place, global_from_frame=moved, instances=None)

    # Munich lies in UTM zone 32, Vienna in zone 33.
    samples = [at(first, "v1", "vienna", 602_000, 5_340_000)]
    samples += [at(sample, "m1", "munich", 691_000, 5_336_000) for sample in others]
    write_annotations(tmp_path / "two.arrow", file.meta, samples)
    words = [str(results), "--ann", str(tmp_path / "two.arrow"), "--out", str(tmp_path / "maps")]
    munich = re.compile(r"EPSG:32632: place 'munich' lies at 48\.1\d+ 11\.5\d+ \(LAT LON\)\n")
    main([*words, "--crs", "EPSG:32632"])
    text = capsys.readouterr().out
    assert munich.search(text)
    assert re.search(r"EPSG:32632: place 'vienna' lies at 48\.2\d+ 10\.3\d+ \(LAT LON\)\n", text)
    assert "EPSG:32632: it is taken for all 2 places; if one lies elsewhere" in text
    main([*words, "--crs", "EPSG:32633", "--scene", "v1"])
    text = capsys.readouterr().out
    assert re.search(r"EPSG:32633: place 'vienna' lies at 48\.2\d+ 16\.3\d+ \(LAT LON\)\n", text)
    assert "munich" not in text
    assert "is taken for all" not in text


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
    with pytest.raises(ValueError, match=rf"{name} exists and is no file of this command"):
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


def test_outputs_of_an_earlier_run_beside_new_ones_are_named(files, tmp_path, capsys):
    results, ann = files
    unknown = tmp_path / "unknown.arrow"  # without ground truth, so without scores
    file = AnnotationFile(ann)
    write_annotations(unknown, file.meta, [replace(sample, instances=None) for sample in file])
    out = tmp_path / "maps"
    words = ["--out", str(out)]
    main([str(results), "--ann", str(ann), *words, "--origin", "48", "11"])
    main([str(results), "--ann", str(ann), *words, "--origin", "48", "11"])
    assert "earlier run" not in capsys.readouterr().out
    (out / "other.geojson").write_text("a map of another drive, which is not old because of this")
    changes = ["--changes", str(out / "scene.geojson")]
    main([str(results), "--ann", str(unknown), *words, *changes])
    text = capsys.readouterr().out
    old = f"{out}/scene_lonlat.geojson, {out}/scores.json"
    assert text.endswith(f"of an earlier run, and not written by this one: {old}\n")
    main([str(results), "--ann", str(ann), *words, "--formats", "svg"])
    text = capsys.readouterr().out
    old = f"{out}/scene.geojson, {out}/scene_lonlat.geojson, {out}/changes.geojson"
    assert text.endswith(f"of an earlier run, and not written by this one: {old}\n")


def test_a_folder_or_a_pipe_under_the_name_of_a_map_is_refused(files, tmp_path):
    results, ann = files
    words = [str(results), "--ann", str(ann), "--out", str(tmp_path)]
    for make in (Path.mkdir, os.mkfifo):
        make(tmp_path / "scene.geojson")
        with pytest.raises(ValueError, match=r"scene\.geojson exists and is no file"):
            main(words)
        os.rename(tmp_path / "scene.geojson", tmp_path / make.__name__)


GRID = BEVGrid((-15, 15), (-30, 30), 200, 100)


def read_prior(path, place):
    """Values at a pose of the drive. (C, H, W)"""
    settings = PriorSettings(CLASSES, place)
    with MapPrior.load(path, settings) as prior:
        return prior.read(drive_of().frames[8].sample.global_from_frame, GRID)


def assert_street(values):
    """The lines of the street, and nothing but them, are in a prior."""
    frame = drive_of().frames[8]
    for label, value in enumerate(values.numpy()):
        lines = frame.elements.select(frame.elements.labels == label).polylines
        shapes = [shapely.LineString(frame.to_frame(line)) for line in lines]
        if CLASSES[label] == "ped_crossing":
            shapes = [shapely.Polygon(shape) for shape in shapes]
        centres = shapely.points(GRID.pixel_centres(dtype=torch.float64).numpy())
        distance = shapely.distance(shapely.union_all(shapes), centres)
        # merging may lose a metre at an end or a corner
        assert (value[distance < 0.05] > 0.5).mean() > 0.95
        assert not value[distance > 0.9].any()


def test_a_prior_of_drives_and_of_their_map_hold_the_street(files, tmp_path, capsys):
    results, ann = files
    prior = tmp_path / "town.prior"
    main([str(results), "--ann", str(ann), "--prior", str(prior)])
    of_drive = read_prior(prior, "town")
    assert_street(of_drive)
    assert os.listdir(tmp_path) == ["town.prior"] or set(os.listdir(tmp_path)) == {
        "town.prior", ".town.prior.lock",
    }  # fmt: skip
    main([str(results), "--ann", str(ann), "--out", str(tmp_path)])
    other = tmp_path / "map.prior"
    report = main(
        ["--map", str(tmp_path / "scene.geojson"), "--ann", str(ann), "--prior", str(other)]
    )
    assert report == "a prior of town"
    of_file = read_prior(other, "town")
    differ = of_file != of_drive  # the file has tenths of a millimetre
    assert differ.float().mean() < 1e-3
    assert re.search(
        r"6 elements: .*scene.geojson\nprior of town, \d+ tiles: ", capsys.readouterr().out
    )
    both = [str(results), "--map", str(tmp_path / "scene.geojson"), "--ann", str(ann)]
    main([*both, "--prior", str(other)])
    of_both = read_prior(other, "town")
    assert (of_both >= of_drive).all()
    assert of_both.max() > of_drive.max()


@pytest.mark.parametrize("kind", [[], ["--elements"], ["--gaussians"]])
def test_a_prior_of_an_unknown_place_is_named_after_its_file(kind, files, tmp_path, capsys):
    results, ann = files
    samples = [replace(sample, map_name="") for sample in AnnotationFile(ann)]
    write_annotations(tmp_path / "a.arrow", AnnotationMeta("own", "lidar", "val"), samples)
    prior = tmp_path / "oslo.prior"
    main([str(results), "--ann", str(tmp_path / "a.arrow"), "--prior", str(prior), *kind])
    assert "prior of oslo, " in capsys.readouterr().out


def test_a_gaussian_prior_of_the_frames_holds_the_street(files, tmp_path, capsys):
    results, ann = files
    path = tmp_path / "town.gaussians"
    words = [str(results), "--ann", str(ann), "--prior", str(path)]
    main([*words, "--gaussians"])
    pose = drive_of().frames[8].sample.global_from_frame
    of_gaussians = open_prior(path).read(pose, GRID)
    main([*words[:-1], str(tmp_path / "town.prior")])
    of_cells = read_prior(tmp_path / "town.prior", "town")
    for label in (CLASSES.index("divider"), CLASSES.index("boundary")):
        cells, lines = of_cells[label] > 0.5, of_gaussians[label] > 0.3
        assert (cells & lines).sum() > 0.8 * cells.sum()
    with pytest.raises(SystemExit):
        main([*words, "--gaussians", "--map", str(tmp_path / "a.geojson")])
    with pytest.raises(SystemExit):
        main([str(results), "--ann", str(ann), "--out", str(tmp_path), "--gaussians"])
    errors = capsys.readouterr().err
    assert "has no Gaussians" in errors
    assert "--gaussians is for a --prior of results" in errors


def test_a_prior_is_made_of_maps_of_other_programs(files, tmp_path, capsys):
    results, ann = files
    origin = ["--origin", "48.26", "11.67"]
    words = [str(results), "--ann", str(ann), "--out", str(tmp_path), *origin]
    main([*words, "--formats", "geojson", "osm"])
    content = json.loads((tmp_path / "scene_lonlat.geojson").read_text())
    del content["crs"], content["generator"]
    for feature in content["features"]:
        feature["properties"] = {"kind": "my " + feature["properties"]["class"]}
    content["features"].append({**feature, "properties": {"kind": "tree"}})
    (tmp_path / "foreign.geojson").write_text(json.dumps(content))
    rule = ["--map-classes", "kind", *(f"my {name}={name}" for name in CLASSES)]
    capsys.readouterr()
    for name, options in (("scene.osm", []), ("foreign.geojson", [*rule, *origin])):
        prior = tmp_path / "town.prior"
        main(["--map", str(tmp_path / name), "--ann", str(ann), "--prior", str(prior), *options])
        assert_street(read_prior(prior, "town"))
    printed = capsys.readouterr().out
    assert "not used: 1 x kind 'tree'\n" in printed
    assert "no element within" not in printed
    elsewhere = ["--origin", "48.36", "11.67"]  # 11 km to the north
    words = ["--map", str(tmp_path / name), "--ann", str(ann), "--prior", str(prior)]
    main([*words, *rule, *elsewhere])
    assert f"{name} has no element within 1000 m of the samples of {ann}" in capsys.readouterr().out
    (tmp_path / name).write_text('{"crs": null, "features": []}')
    main(words)
    printed = capsys.readouterr().out
    assert printed.startswith(f"0 elements: {tmp_path / name}\nprior of town, 0 tiles: ")


def test_changes_since_an_old_map_are_written(files, tmp_path, capsys):
    """The old map has no crossing, a shorter divider, one that is gone, and one that moved."""
    results, ann = files
    main([str(results), "--ann", str(ann), "--out", str(tmp_path)])
    content = json.loads((tmp_path / "scene.geojson").read_text())
    kept = [f for f in content["features"] if f["properties"]["class"] == "boundary"]
    for offset_m, part in ((0.0, slice(60)), (5.0, slice(10, 50)), (2.5, slice(30))):
        line = curve(offset_m)[part].tolist()
        geometry = {"type": "LineString", "coordinates": line}
        kept.append({"type": "Feature", "geometry": geometry, "properties": {"class": "divider"}})
    (tmp_path / "old.geojson").write_text(json.dumps({**content, "features": kept}))
    capsys.readouterr()
    words = [str(results), "--ann", str(ann), "--out", str(tmp_path), "--origin", "48", "11"]
    main([*words, "--changes", str(tmp_path / "old.geojson")])
    printed = capsys.readouterr().out
    assert "changes: 1 removed, 2 added, 1 moved; the old map has no ped_crossing at all" in printed
    written = json.loads((tmp_path / "changes.geojson").read_text())
    assert written["crs"] is None
    assert written["generator"] == "gsmap"
    found = {(f["properties"]["class"], f["properties"]["change"]): f for f in written["features"]}
    assert len(found) == 4
    for (name, kind), feature in found.items():
        values = feature["properties"]
        assert values["map"] == "town"
        assert values["passes_in_view"] == 1
        assert values["passes_not_seen" if kind == "removed" else "passes_seen"] == 1
        assert 0.5 < values["confidence"] <= 1
        assert feature["geometry"]["type"] == (
            "Polygon" if name == "ped_crossing" else "LineString"
        )
    moved = found["divider", "moved"]
    assert moved["properties"]["moved_m"] == pytest.approx(1.0, abs=0.02)
    assert 0 < moved["properties"]["moved_std_m"] < 0.1
    line = shapely.LineString(curve(-1.0))
    assert shapely.hausdorff_distance(line & line.buffer(1), line) < 1
    for point in moved["geometry"]["coordinates"]:
        assert line.distance(shapely.Point(point)) < 0.05
    gone = shapely.LineString(found["divider", "removed"]["geometry"]["coordinates"])
    assert gone.within(shapely.LineString(curve(5.0)).buffer(0.05))
    longer = shapely.LineString(found["divider", "added"]["geometry"]["coordinates"])
    assert longer.within(shapely.LineString(curve(2.5)[29:40]).buffer(0.05))
    assert longer.length == pytest.approx(25, abs=3)
    crossing = shapely.Polygon(found["ped_crossing", "added"]["geometry"]["coordinates"][0])
    assert crossing.intersection(shapely.Polygon(street()[5][1])).area > 0.95 * crossing.area
    degrees = json.loads((tmp_path / "changes_lonlat.geojson").read_text())
    assert degrees["crs"]["properties"]["name"].endswith("CRS84")
    main([*words, "--changes", str(tmp_path / "old.geojson")])  # its own files may be replaced


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "give results, or a --map for a --prior"),
        (["--map", "a.osm"], "--map is for a prior"),
        (["--map", "a.osm", "--out", "b"], "--changes and --out are for results"),
        (["r.json"], "--out or --prior must name the output"),
        (["r.json", "--prior", "p", "--changes", "a.osm"], "--changes goes to the folder --out"),
        (["r.json", "--out", "b", "--map-classes", "a"], "--map-classes is for"),
        (["r.json", "--prior", "p", "--gaussians", "--no-gaussians"], "give one of them"),
        (["r.json", "--prior", "p", "--formats", "osm"], "--formats needs --out: give both"),
        (["r.json", "--prior", "p", "--speed-limit", "30"], "--speed-limit needs --out"),
        (["--map", "a.osm", "--prior", "p", "--join"], "--join needs results: give both"),
        (["--map", "a.osm", "--prior", "p", "--min-confidence", "0.5"], "--min-confidence needs"),
    ],
)
def test_words_that_do_not_belong_together_are_named(options, message, capsys):
    with pytest.raises(SystemExit):
        main([*options, "--ann", "a.arrow"])
    assert message in capsys.readouterr().err


def test_earlier_maps_of_two_places_and_maps_of_none_are_refused(files, tmp_path):
    results, ann = files
    samples = list(AnnotationFile(ann))
    samples[0] = replace(samples[0], map_name="village", scene="other")
    write_annotations(tmp_path / "two.arrow", AnnotationMeta("own", "lidar", "val"), samples)
    words = [str(results), "--ann", str(tmp_path / "two.arrow"), "--prior", str(tmp_path / "p")]
    with pytest.raises(ValueError, match=r"the drives lie in \['town', 'village'\]: .*--scene"):
        main(words)
    main([*words, "--scene", "scene"])
    from_map = ["--map", "a.geojson", *words[1:]]
    for unknown in ([*words, "--scene", "nowhere"], [*from_map, "--scene", "scene", "nowhere"]):
        with pytest.raises(ValueError, match=r"two.arrow has no scene 'nowhere', but \['other'"):
            main(unknown)
    with pytest.raises(ValueError, match="is no map: its name must end in"):
        main([*words, "--scene", "scene", "--map", str(results.with_suffix(".arrow"))])
