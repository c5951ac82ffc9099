"""Result files: reading, pairing by token, the command line, the worker pool."""

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest
from golden_data import CLASSES, EVALUATOR
from processes import run_python

from gsmap.datasets.annotations.file import write_annotations
from gsmap.datasets.annotations.record import AnnotationMeta, MapInstance, MapSample
from gsmap.evaluation.core.file_evaluation import evaluate_files, read_ground_truth
from gsmap.evaluation.core.results_json import read_samples, vectors_of, write_results
from gsmap.structures.elements import MapElements
from mapdata.vectors_json import write_vectors

REPO = Path(__file__).resolve().parents[2]
LABELS = {name: i for i, name in enumerate(CLASSES)}
LINE, RING = [[0.0, -20.0], [0.0, 20.0]], [[2.0, 2.0], [6.0, 2.0], [6.0, 8.0], [2.0, 2.0]]


def vector(points: list, name: str, score: float | None = None) -> dict:
    found = {"pts": points, "pts_num": len(points), "cls_name": name, "type": LABELS.get(name, 9)}
    return found if score is None else {**found, "confidence_level": score}


def truth_of(count: int) -> list[tuple[str, list[dict]]]:
    return [
        (f"t{i}", [vector(LINE, "divider"), vector(RING, "ped_crossing")]) for i in range(count)
    ]


def results_of(count: int) -> list[tuple[str, list[dict]]]:
    """The line is found everywhere, the ring in every second sample."""
    return [
        (f"t{i}", [vector(LINE, "divider", 0.9)] + [vector(RING, "ped_crossing", 0.8)] * (i % 2))
        for i in range(count)
    ]


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    results, truth = tmp_path / "results.json", tmp_path / "truth.json"
    write_results(results, reversed(results_of(8)), {"use_camera": True})
    write_results(truth, truth_of(8), key="GTs")
    return results, truth


def command():
    spec = importlib.util.spec_from_file_location("evaluate_tool", REPO / "tools/evaluate.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.main


def test_command_writes_flat_figures_of_samples_paired_by_token(files, tmp_path, capsys):
    out, curves = tmp_path / "metrics.json", tmp_path / "curves.png"
    arguments = [*map(str, files), "--out", str(out), "--pr-curves", str(curves)]
    assert command()([*arguments, "--eval", "chamfer", "raster"]).startswith("8 samples")
    metrics = json.loads(out.read_text())
    assert metrics["chamfer/divider/AP@0.5"] == 1.0
    assert metrics["chamfer/ped_crossing/AP"] == 0.5
    assert metrics["chamfer/mAP"] == 0.75  # boundary has no ground truth: in no mean
    assert metrics["chamfer/num_absent_classes"] == metrics["raster/num_absent_classes"] == 1
    assert metrics["raster/ped_crossing/AP"] == pytest.approx(51 / 101)
    assert metrics["raster/boundary/AP"] == -1.0
    assert metrics["raster/mAP"] == pytest.approx((1 + 51 / 101) / 2)
    assert metrics["raster/num_samples"] == 8
    assert curves.read_bytes().startswith(b"\x89PNG")
    said = capsys.readouterr().out
    assert "mAP_chamfer = 0.750000" in said
    assert said.count("without ground truth, left out of the means: boundary\n") == 2


def test_annotation_file_and_json_give_the_same_figures(files, tmp_path):
    instances = [MapInstance(0, np.array(LINE)), MapInstance(1, np.array(RING))]
    samples = [MapSample(f"t{i}", "s", "", i, [], np.eye(4), instances=instances) for i in range(8)]
    arrow = tmp_path / "truth.arrow"
    write_annotations(arrow, AnnotationMeta("minicity", "lidar", "val"), samples)
    outs = [tmp_path / "json.json", tmp_path / "arrow.json"]
    for truth, out in zip((files[1], arrow), outs, strict=True):
        command()([str(files[0]), str(truth), "--out", str(out)])
    assert outs[0].read_text() == outs[1].read_text()


def test_prior_is_fitted_on_one_file_and_scored_on_another(files, tmp_path, capsys):
    out = tmp_path / "prior.json"
    command()([str(files[1]), "--prior", str(files[1]), "--out", str(out), "--eval", "chamfer"])
    assert json.loads(out.read_text())["chamfer/divider/AP"] == 1.0
    assert "the same 2 elements in every sample, fitted on 8" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        command()([str(files[1])])
    assert "either a result file or --prior" in capsys.readouterr().err


def test_the_command_starts_without_torch():
    code = "import sys, gsmap.evaluation.analysis.prior; assert 'torch' not in sys.modules"
    run_python("-c", code, check=True)


def test_two_workers_give_the_same_digits(tmp_path):
    results, truth = tmp_path / "results.json", tmp_path / "truth.json"
    write_results(results, results_of(150))
    write_results(truth, truth_of(150), key="GTs")
    one, two = (evaluate_files(results, truth, EVALUATOR, n)[0] for n in (1, 2))
    assert [r.metrics for r in one] == [r.metrics for r in two]


@pytest.mark.parametrize("form", ["json", "arrow"])
def test_command_with_two_processes_writes_the_same_file(tmp_path, form):
    results, truth = tmp_path / "results.json", tmp_path / f"truth.{form}"
    write_results(results, results_of(70))
    instances = [MapInstance(0, np.array(LINE)), MapInstance(1, np.array(RING))]
    rows = [MapSample(f"t{i}", "s", "", i, [], np.eye(4), instances=instances) for i in range(70)]
    if form == "arrow":
        write_annotations(truth, AnnotationMeta("minicity", "lidar", "val"), rows)
    else:
        write_results(truth, truth_of(70), key="GTs")
    written = []
    for workers in ("1", "2"):
        out = tmp_path / f"{workers}.json"
        words = "tools/evaluate.py", results, truth, "--workers", workers, "--out", out
        run_python(*words, check=True)
        written.append(out.read_bytes())
    assert written[0] == written[1]


def test_missing_and_unknown_samples_are_an_error_unless_allowed(tmp_path):
    results, truth = tmp_path / "results.json", tmp_path / "truth.json"
    write_results(results, results_of(3))
    write_results(truth, truth_of(4)[1:], key="GTs")
    with pytest.raises(ValueError, match=r"1 sample has no results, such as 't3'.*'t0'"):
        evaluate_files(results, truth, EVALUATOR)
    reports, notes = evaluate_files(results, truth, EVALUATOR, allow_mismatch=True)
    assert reports[0].metrics["chamfer/divider/recall@0.5"] == pytest.approx(2 / 3)
    assert "counted as without predictions" in notes[0]
    assert "left out" in notes[1]


def test_z_other_classes_and_single_points_are_said(tmp_path):
    results, truth = tmp_path / "results.json", tmp_path / "truth.json"
    line_3d = [[*point, 1.5] for point in LINE]
    found = [vector(line_3d, "divider", 0.9), vector(LINE, "kerb", 0.5)]
    short = [vector(points, "divider", 0.95) for points in ([], [[0, 0]])]
    write_results(results, [("a", found + short)])
    write_results(
        truth, [("a", [vector(LINE, "divider"), vector([[0, 0]], "boundary")])], key="GTs"
    )
    reports, notes = evaluate_files(results, truth, EVALUATOR)
    assert reports[0].metrics["chamfer/divider/AP"] == 1.0
    assert reports[0].metrics["chamfer/boundary/num_gts"] == 1
    text = "; ".join(notes)
    assert "z is ignored" in text
    assert "2 predictions have fewer than two points: they are left out" in text
    assert "1 ground truths have fewer than two points" in text
    assert "1 predictions of class 'kerb' are not scored" in text


def test_heights_count_in_chamfer_if_asked_and_never_in_raster(tmp_path):
    """A line that is right in the plane and 1.2 m too high."""
    results, truth = tmp_path / "results.json", tmp_path / "truth.arrow"
    high = [[*point, 1.2] for point in LINE]
    write_results(results, [("a", [vector(high, "divider", 0.9)])])
    instances = [MapInstance(0, np.array([[*point, 0.0] for point in LINE]))]
    sample = MapSample("a", "s", "", 0, [], np.eye(4), instances=instances)
    write_annotations(truth, AnnotationMeta("mine", "lidar", "val", dim=3), [sample])
    figures = {}
    for dim in ("2", "3"):
        out = tmp_path / f"{dim}.json"
        command()([str(results), str(truth), "--dim", dim, "--out", str(out)])
        figures[dim] = json.loads(out.read_text())
    assert figures["2"]["chamfer/divider/AP@0.5"] == 1.0
    assert figures["3"]["chamfer/divider/AP@1.0"] == 0.0
    assert figures["3"]["chamfer/divider/AP@1.5"] == 1.0
    assert figures["3"]["raster/divider/AP"] == figures["2"]["raster/divider/AP"] > 0.99
    write_results(results, [("a", [vector(LINE, "divider", 0.9)])])
    with pytest.raises(ValueError, match="sample 'a', AP_chamfer of dim 3: points must have 3"):
        command()([str(results), str(truth), "--dim", "3"])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ('{"GTs": []}', r"an object with \['GTs'\] and no list under 'results'"),
        ('{"results": {"a": 1}}', "an object under 'results' and no list .*sample_token"),
        ('{"results": [{"sample_token": "t0", "vectors": []}', "no complete list"),
        ('{"results": [{"vectors": []}]}', "no sample_token"),
        ('{"results": [{"sample_token": "t0", "vectors": [{"pts": [}]}]}', "no complete list|t0"),
        ('{"results": [{"sample_token": "t0"}]}', "t0.*vectors"),
        (
            '{"results": [{"sample_token": "t0", "vectors": []},'
            '{"sample_token": "t0", "vectors": []}]}',
            "more than once",
        ),
        (
            '{"results": [{"sample_token": "t0", "vectors": [{"pts": [[0, 0], [1, 1]],'
            '"cls_name": "divider"}]}]}',
            "t0.*confidence_level",
        ),
        (
            '{"results": [{"sample_token": "t0", "vectors": [{"pts": [[0, 0], [NaN, 1]],'
            '"cls_name": "divider", "confidence_level": 1}]}]}',
            "t0.*not finite",
        ),
        (
            '{"results": [{"sample_token": "t0", "vectors": [{"pts": [[0, 0], [1]],'
            '"cls_name": "divider", "confidence_level": 1}]}]}',
            "t0.*coordinates",
        ),
        (
            '{"results": [{"sample_token": "t0", "vectors": [{"pts": [[0, 0], [1e9, 1]],'
            '"cls_name": "divider", "confidence_level": 1}]}]}',
            "t0.*a line is 1e\\+09 m long, or a point is that far from the vehicle",
        ),
        (  # each point is near, the line is long
            '{"results": [{"sample_token": "t0", "vectors": [{"pts": ['
            + ", ".join(["[0, 0], [9e4, 0]"] * 3)
            + '], "cls_name": "divider", "confidence_level": 1}]}]}',
            "t0.*a line is 4.5e\\+05 m",
        ),
        (  # each line is short enough, all of them are too much
            '{"results": [{"sample_token": "t0", "vectors": ['
            + ", ".join(
                ['{"pts": [[0, 0], [9e4, 0]], "cls_name": "divider", "confidence_level": 1}'] * 12
            )
            + "]}]}",
            "t0.*all lines together are 1.08e\\+06 m long: at most 1000 km",
        ),
        (  # names of two kinds could not be sorted in the notes
            '{"results": [{"sample_token": "t0", "vectors": [{"pts": [[0, 0], [1, 1]],'
            '"cls_name": null, "confidence_level": 1}, {"pts": [[0, 0], [1, 1]],'
            '"cls_name": "other", "confidence_level": 1}]}]}',
            "t0.*cls_name is no text",
        ),
    ],
)
def test_malformed_results_name_the_file_and_the_sample(tmp_path, text, message):
    results, truth = tmp_path / "results.json", tmp_path / "truth.json"
    results.write_text(text)
    write_results(truth, truth_of(1), key="GTs")
    with pytest.raises(ValueError, match=message):
        evaluate_files(results, truth, EVALUATOR)
    with pytest.raises(ValueError, match=message):
        command()([str(results), str(truth)])


def test_samples_are_read_from_any_layout_of_the_file(tmp_path):
    path = tmp_path / "odd.json"
    path.write_text(
        '{"meta": {"results": [1], "text": "a \\" ] } [ {"}, "other": [[{}], "results"],\n'
        ' "results" : [ {"vectors": [], "extra": {"deep": [{}]}, "sample_token": "x\\u0041"},\n'
        '{"sample_token": "b]", "was": [{"sample_token": "c"}], "vectors": [ ]} ], "tail": [{}]}'
    )
    samples, ignored = read_samples(path, "results", CLASSES)
    assert list(samples) == ["xA", "b]"]
    assert [len(elements) for elements in samples.values()] == [0, 0]
    assert not ignored


def test_written_predictions_read_back(tmp_path):
    gaussians = [np.ones((n, 2)) for n in (2, 4)], [np.zeros(n) for n in (2, 4)]
    elements = MapElements.from_polylines([LINE, RING], [0, 1], [0.25, 0.1 + 0.2], *gaussians)
    vectors = vectors_of(elements, CLASSES)
    path = tmp_path / "new" / "out.json"
    write_results(path, [("a", vectors)])
    written = json.loads(path.read_text())["results"][0]["vectors"]
    assert written[1]["gaussian_scales"] == [[1.0, 1.0]] * 4
    back = read_samples(path, "results", CLASSES)[0]["a"]
    assert back.scores.tolist() == [0.25, 0.1 + 0.2]
    assert back.labels.tolist() == [0, 1]
    assert [p.tolist() for p in back.polylines] == [LINE, RING]
    assert list(path.parent.iterdir()) == [path]


def test_interrupted_writing_leaves_nothing(tmp_path):
    def broken():
        yield "a", []
        raise KeyError("b")

    with pytest.raises(KeyError):
        write_results(tmp_path / "out.json", broken())
    assert list(tmp_path.iterdir()) == []


def test_annotation_file_without_ground_truth_or_class_is_refused(tmp_path):
    arrow = tmp_path / "truth.arrow"
    sample = MapSample("t0", "s", "", 0, [], np.eye(4))
    write_annotations(arrow, AnnotationMeta("minicity", "lidar", "val"), [sample])
    with pytest.raises(ValueError, match="'t0' has no ground truth"):
        read_ground_truth(arrow, CLASSES)
    with pytest.raises(ValueError, match="stop_line"):
        read_ground_truth(arrow, ("divider", "stop_line"))


def test_elements_of_other_classes_have_no_label_and_are_counted(tmp_path):
    """A divider, two crossings and a boundary; crossings are not asked for."""
    line = np.array([[0.0, 0.0], [1.0, 0.0]])
    instances = [MapInstance(label, line) for label in (0, 1, 1, 2)]
    sample = MapSample("a", "scene", "town", 0, [], np.eye(4), instances=instances)
    path = tmp_path / "truth.arrow"
    write_annotations(path, AnnotationMeta("x", "lidar", "val"), [sample])
    found, ignored = read_ground_truth(path, ("boundary", "divider"))
    assert found["a"].labels.tolist() == [1, -1, -1, 0]
    assert +ignored == {"ped_crossing": 2}  # without the zeros


def annotated(path: Path, count: int, scenes: int = 1, **options: object) -> Path:
    """Write the truth of ``truth_of`` as an annotation file of some scenes."""
    lines = [np.array(LINE, np.float32), np.array(RING, np.float32)]
    samples = (
        MapSample(
            f"t{i}", f"s{i % scenes}", "town", i, [], np.eye(4),
            instances=[MapInstance(label, line) for label, line in enumerate(lines)],
        )
        for i in range(count)
    )  # fmt: skip
    write_annotations(path, AnnotationMeta("nuscenes", "lidar", "val", options=options), samples)
    return path


def test_a_prior_of_another_split_is_refused_unless_allowed(tmp_path, capsys):
    here, other = ("near@" + digit * 16 for digit in "01")
    truth = annotated(tmp_path / "val.arrow", 4, split_list=here)
    train = annotated(tmp_path / "train.arrow", 4, split_list=other)
    words = [str(truth), "--prior", str(train), "--eval", "chamfer"]
    with pytest.raises(ValueError, match=f"prior of .*train.arrow was .* {other}, .*{here}"):
        command()(words)
    command()([*words, "--allow-other-split"])
    command()([str(truth), "--prior", str(truth), "--eval", "chamfer"])
    assert capsys.readouterr().out.count("fitted on 4 training samples") == 2


@pytest.mark.parametrize("name", ["trained_on", "split_list"])
def test_results_of_a_model_of_another_split_are_refused_unless_allowed(tmp_path, name):
    here, other = ("near@" + digit * 16 for digit in "01")
    truth = annotated(tmp_path / "val.arrow", 4, split_list=here)
    for said in (here, None):
        write_results(tmp_path / "own.json", results_of(4), {name: said})
        evaluate_files(tmp_path / "own.json", truth, EVALUATOR)
    results = tmp_path / "other.json"
    write_results(results, results_of(4), {name: other})
    with pytest.raises(ValueError, match=f"other.json was trained on the split {other}, .*{here}"):
        evaluate_files(results, truth, EVALUATOR)
    evaluate_files(results, truth, EVALUATOR, allow_other_split=True)
    for hostile in ("near\n", ["near"], 5):
        write_results(results, results_of(4), {name: hostile})
        with pytest.raises(ValueError, match="split_list must be a name with a digest"):
            evaluate_files(results, truth, EVALUATOR)


EGO_LINES = {
    "divider": [[-28.0, 1.0], [28.0, 1.0]],
    "ped_crossing": [[20.0, -4.0], [24.0, -4.0], [24.0, 4.0], [20.0, -4.0]],
    "centerline": [[-30.0, -2.0], [30.0, -2.0]],
}


def write_ego_truth(folder: Path) -> tuple[Path, Path, Path]:
    """Results equal to the ground truth, the annotation file, and its export, in frame `ego`."""
    classes = tuple(EGO_LINES)
    meta = AnnotationMeta(
        dataset="own", frame="ego", split="val", classes=classes, x_range=(-30.0, 30.0),
        y_range=(-15.0, 15.0), ground_z_m=0.0, command="",
    )  # fmt: skip
    instances = [
        MapInstance(label=label, points=np.array(points))
        for label, points in enumerate(EGO_LINES.values())
    ]
    sample = MapSample("t0", "s", "", 0, [], np.eye(4), instances=instances)
    write_annotations(folder / "val.arrow", meta, [sample])
    write_vectors([folder / "val.arrow"], folder / "val.json")
    vectors = [vector(points, name, 0.9) for name, points in EGO_LINES.items()]
    write_results(folder / "results.json", [("t0", vectors)])
    return folder / "results.json", folder / "val.arrow", folder / "val.json"


def test_an_export_has_the_classes_and_the_range_of_its_file(tmp_path, capsys):
    """A crossing 20 m ahead in frame `ego` is outside of nuScenes' canvas of 15 m."""
    results, annotations, export = write_ego_truth(tmp_path)
    figures = []
    for truth in (annotations, export):
        out = tmp_path / f"{truth.name}.figures"
        command()([str(results), str(truth), "--out", str(out)])
        figures.append(json.loads(out.read_text()))
    assert figures[0] == figures[1]
    assert figures[0]["chamfer/mAP"] == 1.0
    for name in ("raster/mAP", "raster/centerline/AP"):
        assert figures[0][name] == pytest.approx(1.0)  # a mean over 101 recalls
    assert "note:" not in capsys.readouterr().out


def test_ground_truth_outside_of_the_canvas_is_noted(tmp_path, capsys):
    results, _, export = write_ego_truth(tmp_path)
    content = json.loads(export.read_text())
    del content["meta"]  # as MapTR writes it
    export.write_text(json.dumps(content))
    note = (
        "note: ground truth reaches x -30 to 30 and y -4 to 4 m, and the canvas of raster metrics "
        "is x -15 to 15 and y -30 to 30 m: they do not count parts outside (--range)"
    )
    command()([str(results), str(export)])
    assert note in capsys.readouterr().out
    for words in (["--range", "-30", "-15", "30", "15"], ["--eval", "chamfer"]):
        command()([str(results), str(export), *words])
        assert "ground truth reaches" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("priors", "said"),
    [
        ([{"also_predicted": 0}, {"also_predicted": 7}, {"also_predicted": 2}], "leak: 7 samples"),
        ([{"also_predicted": 0}], ""),
        ([{"also_predicted": True}, {"also_predicted": "9"}, {}, 3, None], ""),  # not by us
        ({"also_predicted": 7}, ""),
    ],
)
def test_results_with_a_prior_of_their_samples_are_noted(priors, said, tmp_path, capsys):
    truth = annotated(tmp_path / "val.arrow", 8)
    write_results(tmp_path / "results.json", results_of(8), {"priors": priors})
    command()([str(tmp_path / "results.json"), str(truth), "--eval", "chamfer"])
    printed = capsys.readouterr().out
    assert ("leak:" in printed) == bool(said)
    assert said in printed


def test_a_description_behind_the_ground_truth_is_refused(tmp_path):
    """Where the keys are sorted, ``GTs`` comes before ``meta``."""
    results, _, export = write_ego_truth(tmp_path)
    content = json.loads(export.read_text())
    export.write_text(json.dumps(content, sort_keys=True))
    with pytest.raises(ValueError, match=r"\(classes, x_range, y_range\) stands behind .* before"):
        command()([str(results), str(export)])
    content["meta"] = {"author": "us"}
    export.write_text(json.dumps(content, sort_keys=True))
    command()([str(results), str(export)])


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"classes": "divider"}, "classes must be a list of names"),
        ({"classes": [1]}, "classes must be a list of names"),
        ({"x_range": [30, -30]}, "x_range must be"),
        ({"x_range": [30]}, "meta of .*val.json"),
        ({"y_range": ["a", "b"]}, "meta of .*val.json"),
        ({"y_range": None}, "meta of .*val.json"),
    ],
)
def test_a_malformed_description_of_ground_truth_is_refused(entry, message, tmp_path):
    results, _, export = write_ego_truth(tmp_path)
    content = json.loads(export.read_text())
    content["meta"] |= entry
    export.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=message):
        command()([str(results), str(export)])
