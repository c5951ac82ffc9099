"""Tracks, C-mAP and jitter: worked by hand, and equal to MapTracker's tools."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from report_case import vector, write_case

from gsmap.datasets.annotations.file import AnnotationFile, write_annotations
from gsmap.datasets.annotations.record import AnnotationMeta, MapInstance, MapSample
from gsmap.evaluation.analysis.consistency import (
    ConsistencyConfig,
    DriveFrame,
    consistency,
    group_by_scene,
    jitter,
    make_tracks,
    track_drive,
    with_lines,
)
from gsmap.evaluation.analysis.drive_files import drive_frames, evaluate_drives
from gsmap.evaluation.core.results_json import vectors_of, write_results
from gsmap.structures.elements import MapElements
from gsmap.structures.grid import BEVGrid
from gsmap.structures.rigid import rigid
from tools import evaluate

GRID = BEVGrid((-30, 30), (-15, 15))
CONFIG = ConsistencyConfig(("ped_crossing", "divider", "boundary"), GRID, (0,))


@pytest.fixture(scope="module")
def golden(golden_dir):
    return json.loads((golden_dir / "eval/cmap_A.json").read_text())


def golden_frames(golden) -> list[DriveFrame]:
    """Return the frames of the reference example."""
    frames = []
    for frame in golden["frames"]:
        sides = [
            MapElements.from_polylines(
                [e["pts"] for e in frame[side]],
                [e["label"] for e in frame[side]],
                [e["score"] for e in frame[side]] if side == "pred" else None,
            )
            for side in ("pred", "gt")
        ]
        pose = rigid(frame["ego2global_rotation"], frame["ego2global_translation"])
        frames.append(DriveFrame(frame["token"], frame["scene"], pose, *sides))
    return frames


def test_figures_equal_maptrackers(golden):
    expected = golden["expected"]
    found = consistency(golden_frames(golden), CONFIG)
    assert found["consistency/C-mAP"] == pytest.approx(expected["consistent"]["mAP"], abs=1e-12)
    assert found["consistency/mAP"] == pytest.approx(expected["plain"]["mAP"], abs=1e-12)
    for ours, theirs in (("CAP", "consistent"), ("AP", "plain")):
        for threshold, of_class in expected[theirs]["AP"].items():
            for name, value in of_class.items():
                key = f"consistency/{ours}@{threshold}/{name}"
                assert found[key] == pytest.approx(value, abs=1e-12)
    for look_back, value in expected["cmap_other_look_back"].items():
        other = consistency(golden_frames(golden), replace(CONFIG, look_back=int(look_back)))
        assert other["consistency/C-mAP"] == pytest.approx(value, abs=1e-12)


def test_tracks_equal_maptrackers(golden):
    """Numbers may differ: tracks are paired, both ways."""
    expected = golden["expected"]
    wanted = {entry["token"]: entry for entry in expected["pred_tracks"]}
    for scene in group_by_scene(golden_frames(golden)):
        truths = make_tracks([with_lines(f, f.truth) for f in scene], CONFIG, 1, 1e-2)
        numbers = expected["gt_track_ids"][scene[0].scene]
        pairs = set()
        for frame, own, ids in zip(scene, truths, numbers, strict=True):
            for label in range(3):
                of_class = own[frame.truth.labels == label].tolist()
                pairs |= {(label, *p) for p in zip(of_class, ids.get(str(label), []), strict=True)}
        assert len(pairs) == len({p[:2] for p in pairs}) == len({(p[0], p[2]) for p in pairs})
        pairs = set()
        for frame, own in zip(scene, track_drive(scene, CONFIG), strict=True):
            for label in range(3):
                entry, key = wanted[frame.token], str(label)
                by_score = dict(zip(entry["kept_scores"][key], entry["ids"][key], strict=True))
                for row in np.flatnonzero((frame.predictions.labels == label) & (own >= 0)):
                    score = round(float(frame.predictions.scores[row]), 6)
                    pairs.add((int(own[row]), by_score[score]))
        assert len(pairs) == len({a for a, _ in pairs}) == len({b for _, b in pairs})


def drive(*offsets_m: float, scores: tuple[float, ...] = ()) -> list[DriveFrame]:
    """Return frames 2 m apart along x; each predicts a divider so far to the left of the true."""
    frames = []
    for number, offset in enumerate(offsets_m):
        ends = np.array([[-20.0, 3.0], [20.0, 3.0]])
        score = scores[number] if scores else 0.9
        frames.append(
            DriveFrame(
                str(number),
                "a",
                rigid(np.eye(3), [2.0 * number, 0, 0]),
                MapElements.from_polylines([ends + np.array([0, offset])], [1], [score]),
                MapElements.from_polylines([ends], [1]),
            )
        )
    return frames


def test_a_second_track_of_the_same_element_counts_against_it():
    """The second frame's track is another: one of two hits is taken back, so AP is 1/2."""
    frames = drive(0.0, 0.0)
    for number, frame in enumerate(frames):
        frame.track_ids = np.array([number])
    found = consistency(frames, CONFIG)
    assert found["consistency/CAP@0.5/divider"] == pytest.approx(0.5)
    assert found["consistency/AP@0.5/divider"] == pytest.approx(1.0)
    assert found["consistency/jitter_m"] == -1.0
    for frame in frames:
        frame.track_ids = np.array([7])
    assert consistency(frames, CONFIG)["consistency/CAP@0.5/divider"] == pytest.approx(1.0)


def test_predictions_without_a_track_are_none_to_each_other():
    """The first owns the element, so the second counts as false: AP is 1/2."""
    frames = drive(0.0, 0.0)
    for frame in frames:
        frame.track_ids = np.array([-1])
    found = consistency(frames, CONFIG)
    assert found["consistency/CAP@0.5/divider"] == pytest.approx(0.5)
    assert found["consistency/AP@0.5/divider"] == pytest.approx(1.0)
    assert found["consistency/jitter_m"] == -1.0


def test_a_track_of_another_class_with_the_same_number_does_not_jitter():
    """MapTracker numbers its tracks by class: the boundary was 2 m beside the divider."""
    frames = [replace(frame, pose=np.eye(4)) for frame in drive(0.0, 0.0)]
    line = frames[0].predictions.polylines[0]
    both = MapElements.from_polylines([line, line + np.array([0, 2.0])], [1, 2], [0.9, 0.9])
    frames[0].predictions = both
    assert jitter(frames, [np.zeros(2, int), np.zeros(1, int)], GRID).tolist() == [0.0]


def test_a_low_score_has_no_track_and_does_not_count():
    found = track_drive(drive(0.0, 0.0, scores=(0.4, 0.41)), CONFIG)
    assert [ids.tolist() for ids in found] == [[-1], [0]]


def test_jitter_is_how_far_a_line_moves_over_the_ground():
    """A line that lies 0.3 m, then 0 m to the left has moved by 0.3 m."""
    frames = [replace(frame, pose=np.eye(4)) for frame in drive(0.3, 0.0)]
    steps = jitter(frames, track_drive(frames, CONFIG), GRID)
    assert steps.tolist() == pytest.approx([0.3], abs=1e-2)
    # driven 2 m, the line came along: its points of every s = 40 m / 199 lie 0.05 s beside one now,
    # but for the ten behind its end, 2 m - i s from it
    step = 40 / 199
    expected = (sum(2 - i * step for i in range(10)) + 190 * 0.05 * step) / 200
    assert jitter(drive(0.0, 0.0), [np.zeros(1, int)] * 2, GRID)[0] == pytest.approx(expected)


@pytest.fixture
def files(tmp_path):
    """Write a drive's annotation and result file."""
    frames = drive(0.1, 0.0, 0.2)
    samples = [
        MapSample(
            token=frame.token,
            scene="a",
            map_name="",
            timestamp_ns=number * 500_000_000,
            cameras=[],
            global_from_frame=frame.pose,
            instances=[MapInstance(1, line) for line in frame.truth.polylines],
        )
        for number, frame in enumerate(frames)
    ]
    meta = AnnotationMeta("own", "ego", "val", CONFIG.classes, GRID.x_range, GRID.y_range)
    write_annotations(tmp_path / "own.arrow", meta, samples)
    results = [(f.token, vectors_of(f.predictions, CONFIG.classes)) for f in frames]
    write_results(tmp_path / "results.json", results, {"trained_on": "official"})
    return tmp_path / "results.json", AnnotationFile(tmp_path / "own.arrow")


def test_tracks_are_written_and_read_again(files, tmp_path):
    results, annotations = files
    figures = evaluate_drives(results, annotations, CONFIG, tmp_path / "tracks.json")
    frames = drive_frames(tmp_path / "tracks.json", annotations, CONFIG.classes)
    assert [frame.track_ids.tolist() for frame in frames] == [[0]] * 3
    about = json.loads((tmp_path / "tracks.json").read_text())["meta"]
    assert about == {"trained_on": "official", "classes": list(CONFIG.classes)}
    assert evaluate_drives(tmp_path / "tracks.json", annotations, CONFIG) == figures
    # Two of three classes have no ground truth, and do not count in the means.
    assert figures["consistency/C-mAP"] == figures["consistency/mAP"] == pytest.approx(1)
    assert figures["consistency/num_absent_classes"] == 2
    assert figures["consistency/CAP@1.0/boundary"] == -1


def test_a_missing_sample_and_a_bad_track_are_named(files, tmp_path):
    results, annotations = files
    content = json.loads(results.read_text())
    content["results"][1]["vectors"][0]["track_id"] = "x"
    (tmp_path / "bad.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"bad\.json, sample '1': track_id must be an integer"):
        drive_frames(tmp_path / "bad.json", annotations, CONFIG.classes)
    del content["results"][1]
    (tmp_path / "less.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"less\.json has no sample '1' \(1 are missing\)"):
        drive_frames(tmp_path / "less.json", annotations, CONFIG.classes)


def test_tracks_of_some_vectors_only_are_refused(files, tmp_path):
    results, annotations = files
    content = json.loads(results.read_text())
    content["results"][1]["vectors"][0]["track_id"] = 3
    (tmp_path / "some.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"some\.json: sample '1' has tracks, sample '2' has none"):
        drive_frames(tmp_path / "some.json", annotations, CONFIG.classes)
    content["results"][1]["vectors"][0]["track_id"] = True
    (tmp_path / "some.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"track_id must be an integer .* got True"):
        drive_frames(tmp_path / "some.json", annotations, CONFIG.classes)


def test_a_track_twice_in_a_sample_is_named(files, tmp_path):
    results, annotations = files
    content = json.loads(results.read_text())
    for sample in content["results"]:
        sample["vectors"] = [{**vector, "track_id": 4} for vector in sample["vectors"]]
    twice = content["results"][1]["vectors"]
    twice.append({**twice[0], "track_id": -1})  # any number can have none
    twice.append({**twice[0], "track_id": -1})
    twice.append({**twice[0], "cls_name": "boundary", "type": 2})  # MapTracker's are of a class
    (tmp_path / "twice.json").write_text(json.dumps(content))
    drive_frames(tmp_path / "twice.json", annotations, CONFIG.classes)
    drive_frames(tmp_path / "twice.json", annotations, ("ped_crossing",))  # others are not scored
    twice.append(twice[0])
    (tmp_path / "twice.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"sample '1': two elements of a class have track_id 4"):
        drive_frames(tmp_path / "twice.json", annotations, CONFIG.classes)


@pytest.mark.parametrize("points", [[], [[3.0, 3.0]]])
@pytest.mark.parametrize("has_tracks", [False, True])
def test_predictions_that_are_no_lines_do_not_count(points, has_tracks, files, tmp_path):
    results, annotations = files
    figures = evaluate_drives(results, annotations, CONFIG)
    content = json.loads(results.read_text())
    for sample in content["results"]:
        short = {**sample["vectors"][0], "pts": points, "pts_num": len(points)}
        sample["vectors"].insert(0, short)
        for number, own in enumerate(sample["vectors"]):
            if has_tracks:
                own["track_id"] = number
    (tmp_path / "short.json").write_text(json.dumps(content))
    tracked = tmp_path / "tracked.json"
    assert evaluate_drives(tmp_path / "short.json", annotations, CONFIG, tracked) == figures
    for frame in drive_frames(tracked, annotations, CONFIG.classes):
        assert len(frame.predictions) == 1
        assert frame.track_ids.tolist() == [int(has_tracks)]


def test_the_command_scores_drives_and_writes_tracks(files, tmp_path, capsys):
    results, annotations = files
    tracks, figures = tmp_path / "tracks.json", tmp_path / "figures.json"
    words = [str(annotations.path), "--eval", "chamfer", "--consistency"]
    evaluate.main([str(results), *words, "--tracks", str(tracks), "--out", str(figures)])
    assert "consistency/C-mAP" in capsys.readouterr().out
    assert json.loads(figures.read_text())["consistency/C-mAP"] == pytest.approx(1)
    evaluate.main([str(tracks), *words])
    for metric in ("chamfer", "raster"):
        words[2] = metric
        evaluate.main([str(results), *words, "--hard", "--out", str(figures)])
        found = set(re.findall(r"consistency/CAP@([\d.]+)", figures.read_text()))
        assert found == {"0.2", "0.5", "1.0"}
    with pytest.raises(FileNotFoundError, match=r"gone\.json"):
        evaluate.main([str(tmp_path / "gone.json"), *words])
    tracks.write_text(tracks.read_text().replace('"sample_token":"1"', '"sample_token":"x"'))
    with pytest.raises(ValueError, match=r"tracks\.json has no sample '1' \(1 are missing\)"):
        evaluate.main([str(tracks), *words, "--allow-mismatch"])


def test_rules_out_of_range_are_refused():
    with pytest.raises(ValueError, match="look_back must be >= 1, got 0"):
        replace(CONFIG, look_back=0)
    for thresholds in ((0.0,), (0.5, math.nan, 1.0), (math.nan,), (math.inf,), ()):
        with pytest.raises(ValueError, match="thresholds must be > 0 m"):
            replace(CONFIG, thresholds=thresholds)


def test_the_order_and_the_choice_of_classes_do_not_mix_them_up(tmp_path):
    path, results = write_case(tmp_path)
    file = AnnotationFile(path)
    orders = [("divider", "ped_crossing", "boundary"), ("boundary", "divider", "ped_crossing")]
    figures = []
    for classes in orders:
        config = replace(CONFIG, classes=classes, filled_classes=())
        figures.append(evaluate_drives(results["good"], file, config)["consistency/C-mAP"])
    assert figures[0] == figures[1] > 0
    alone = evaluate_drives(
        results["good"], file, replace(CONFIG, classes=("boundary",), filled_classes=())
    )
    assert alone["consistency/C-mAP"] == 1
    unknown = replace(CONFIG, classes=("centerline",))
    with pytest.raises(ValueError, match=r"has the classes .*, not \['centerline'\]"):
        evaluate_drives(results["good"], file, unknown)


def test_written_tracks_have_the_gaussians_and_no_element_of_another_class(tmp_path):
    path, results = write_case(tmp_path)
    content = json.loads(results["good"].read_text())
    for sample in content["results"]:
        sample["vectors"].append(vector("centerline", 0.95, [[0, 0], [0, 9]]))
    results["good"].write_text(json.dumps(content))
    evaluate_drives(results["good"], AnnotationFile(path), CONFIG, tmp_path / "tracks.json")
    for sample in json.loads((tmp_path / "tracks.json").read_text())["results"]:
        names = [found["cls_name"] for found in sample["vectors"]]
        assert names == ["divider", "boundary", "divider"]
        for found in sample["vectors"]:
            assert len(found["gaussian_scales"]) == len(found["pts"])
