import base64
import hashlib
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from processes import run_tool
from report_case import CLASSES, FRAMES, RING, STRANGE, write_case, write_changes_case
from scipy.spatial.transform import Rotation

from gsmap.datasets.annotations.file import AnnotationFile, write_annotations
from gsmap.evaluation.analysis.distances import cut_by_distance, distance_groups
from gsmap.evaluation.analysis.groups import ap_by_group, group_table
from gsmap.evaluation.core.chamfer_ap import ChamferConfig
from gsmap.evaluation.core.evaluator import MapEvaluator
from gsmap.evaluation.core.file_evaluation import SamplePairs
from gsmap.evaluation.core.results_json import RESULTS_KEY, read_samples
from gsmap.structures.frames import FRAME_VIEWS
from gsmap.visualization.page.changes import ChangeLayer
from gsmap.visualization.page.frames import cameras_of, choose_frames
from gsmap.visualization.page.page import PageOptions, page_data, page_html

REPO = Path(__file__).resolve().parents[3]
NO_IMAGES = PageOptions(image_width=0)


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    return write_case(tmp_path_factory.mktemp("case"))


@pytest.fixture(scope="module")
def data(case):
    return page_data(*case, PageOptions())


def test_predictions_hit_within_a_metre_and_the_tables_agree(data):
    """The first divider stands 0, 0.4, 0.8, 1.2 ... m from the annotated one."""
    found = [frame["found"][0] for frame in data["frames"]]
    assert [[item["s"] for item in items] for items in found] == [[0.9, 0.5, 0.3]] * FRAMES
    assert [items[0]["hit"] for items in found] == [0, 0, 0, -1, -1, -1]
    assert [items[1]["hit"] for items in found] == [2] * FRAMES
    assert [items[2]["hit"] for items in found] == [-1] * FRAMES
    assert found[1][0]["p"][:4] == [40, -2000, 40, -1600]
    assert found[1][0]["g"][:3] == [200, 50, 90]
    assert "g" not in data["frames"][0]["found"][1][0]
    # dividers at 1 m: ranks 1, 2, 3 hit, then recall stays at 1/2: AP = 1/2; boundaries are perfect
    rows = data["tables"][1]["rows"]
    column = data["tables"][1]["head"].index("at 1.0 m")
    assert [row[column] for row in rows] == ["50.0", "0.0", "0.0", "0.0", "100.0", "100.0"]
    # mAP: dividers (2/6 + 3/6 + 4/6) / 3, crossings 0, boundaries 1
    assert data["tables"][0]["rows"][0][1:] == ["50.0", "33.3", "-16.7"]


def test_the_page_shows_intervals_of_scenes_and_where_results_differ_most(case, tmp_path):
    """Scenes of two samples: F1 is 4/5 and 2/4 in the first three samples, then 2/5 and 2/4."""
    path, results = case
    file = AnnotationFile(path)
    samples = [replace(sample, scene=f"s{i // 2}") for i, sample in enumerate(file)]
    write_annotations(tmp_path / "scenes.arrow", file.meta, samples)
    tables = page_data(tmp_path / "scenes.arrow", results, NO_IMAGES)["tables"]
    for cell, value, sign in zip(
        tables[0]["rows"][0][1:], ("50.0", "33.3", "-16.7"), ("", "", "[+-]"), strict=True
    ):
        low, high = re.fullmatch(rf"{value} \(({sign}[\d.]+) to ({sign}[\d.]+)\)", cell).groups()
        assert float(low) <= float(value) <= float(high)
    assert tables[0]["rows"][0][2] == "33.3 (33.3 to 33.3)"  # boundaries are perfect everywhere
    rows = tables[-1]["rows"]
    assert rows[0][1:] == ["t0", "0.80", "0.50", "-0.30"]
    assert rows[3][1:] == ["t3", "0.40", "0.50", "+0.10"]
    assert [row[1] for row in rows] == [f"t{i}" for i in range(FRAMES)]


def test_of_two_results_the_frames_in_which_they_differ_are_added():
    class Result:
        def __init__(self, **low):
            self.low = low

        def f1(self, token, score_thr):
            return self.low.get(token, 1.0)

    tokens = list("abcdefghij")
    both = [Result(h=0.0, i=0.1), Result(h=0.0, i=0.5, g=0.9)]
    assert choose_frames(tokens, 4, both, 0.4) == [0, 4, 8, 9]


def test_curves_end_at_the_recall_that_is_reached(data):
    divider = next(p for p in data["curves"] if p["metric"] == "AP_chamfer" and p["class"] == 0)
    line = next(line for line in divider["lines"] if line["label"] == "1.0 m")
    assert line["ap"] == ["50.0", "0.0"]
    good, poor = line["points"]
    assert good[2] == [0.5, 1.0]
    assert good[-1] == [0.5, 0.25]
    assert poor == []


def test_gaussians_have_curves_of_reliability_and_results_without_them_none(data):
    panels = data["reliability"]
    assert [panel["class"] for panel in panels] == [0, 2]  # the crossing is never found
    for panel in panels:
        assert [line["label"][:6] for line in panel["lines"]] == ["along,", "across"]
        for line in panel["lines"]:
            levels, shares = np.transpose(line["points"][0])
            assert levels[0] == 0.05
            assert levels[-1] == 0.95
            assert (np.diff(shares) >= 0).all()
            assert line["points"][1] == []
            assert line["ap"][1] == "\N{EN DASH}"
    assert panels[1]["lines"][1]["ap"][0] == "100.0"  # boundaries are perfect


def test_intervals_are_of_the_law_that_results_or_the_options_name(case, tmp_path):
    path, results = case
    content = json.loads(results["good"].read_text())
    calibrated = tmp_path / "calibrated.json"
    meta = {"calibration": {"law": "laplace", "sigmas": 1.0}}
    calibrated.write_text(json.dumps({**content, "meta": meta}))

    def panels(law=None, **files):
        return page_data(path, files, replace(NO_IMAGES, law=law))["reliability"]

    normal, laplace = panels(a=results["good"]), panels(a=calibrated)
    assert panels("laplace", a=results["good"]) == laplace
    assert panels("normal", a=calibrated) == normal
    # a panel's curve of errors across of the divider: 0, 0.4, 0.8, 1.2 m at a sigma of 0.5 m
    shares = [panel[0]["lines"][1]["points"][0] for panel in (normal, laplace)]
    assert dict(shares[0])[0.65] == 0.5  # within 0.935 sigma
    assert dict(shares[1])[0.65] == 0.25  # within 0.742 sigma
    assert laplace[0]["lines"][1]["label"] == "across, in the interval of 68.3 % (laplace law)"
    both = panels(a=results["good"], b=calibrated)
    assert "(normal | laplace law)" in both[0]["lines"][0]["label"]
    assert both[0]["lines"][1]["points"] == shares


def test_results_of_a_model_of_another_split_are_refused_unless_allowed(case, tmp_path):
    path, results = case
    file, (here, other) = AnnotationFile(path), ("near@" + digit * 16 for digit in "01")
    meta = replace(file.meta, options={"split_list": here})
    write_annotations(tmp_path / "val.arrow", meta, list(file))
    content = json.loads(results["good"].read_text())
    (tmp_path / "r.json").write_text(json.dumps({**content, "meta": {"trained_on": other}}))
    files = {"a": tmp_path / "r.json"}
    with pytest.raises(ValueError, match=f"r.json was trained on the split {other}, .*{here}"):
        page_data(tmp_path / "val.arrow", files, NO_IMAGES)
    allowed = replace(NO_IMAGES, allow_other_split=True)
    assert page_data(tmp_path / "val.arrow", files, allowed)["results"] == ["a"]


def test_parts_of_the_samples_have_a_table(case, tmp_path):
    path, results = case
    options = PageOptions(image_width=0, by="map")
    (table,) = (
        t for t in page_data(path, results, options)["tables"] if "by map, good" in t["caption"]
    )
    assert table["rows"][0][:3] == ["town", str(FRAMES), "50.0"]


def test_the_map_near_and_far_has_a_table_that_equals_the_commands(case):
    path, results = case
    tables = page_data(path, results, replace(NO_IMAGES, by="distance"))["tables"]
    (table,) = (t for t in tables if "by distance, good" in t["caption"])
    classes = AnnotationFile(path).meta.classes
    evaluator = MapEvaluator(ChamferConfig(classes))
    pieces = cut_by_distance(SamplePairs(results["good"], path, classes), areas=[1])
    reports = evaluator.reports(evaluator.match(*sample) for sample in pieces)
    groups = distance_groups(reports[0].tokens)
    head, rows = group_table(reports, groups, ap_by_group(reports, groups))
    assert [row[: len(head)] for row in table["rows"]] == rows
    assert [row[0] for row in rows] == ["0-10 m", "10-20 m", "beyond 20 m"]


def test_frames_are_spread_evenly_and_the_worst_are_added(case):
    class Result:
        def f1(self, token, score_thr):
            return {"7": 0.1, "8": 0.0, "0": 0.05}.get(token, 1.0)

    tokens = [str(i) for i in range(10)]
    assert choose_frames(tokens, 10, [Result()], 0.4) == list(range(10))
    assert choose_frames(tokens, 4, [], 0.4) == [0, 3, 6, 9]
    # three evenly (0, 4, 9), then the worst that is not among them
    assert choose_frames(tokens, 4, [Result()], 0.4) == [0, 4, 8, 9]
    some = page_data(*case, replace(NO_IMAGES, max_frames=4))
    assert some["notes"] == [
        "The page shows 4 of 6 frames: 3 evenly spread and 1 in which both results differ most."
    ]


def test_cameras_stand_as_on_the_car_and_see_the_ground(case):
    sample = AnnotationFile(case[0])[0]
    view = replace(FRAME_VIEWS["lidar"], ground=(0.01, -0.02, -1.8))
    point = [3.0, 17.0, 0.01 * 3 - 0.02 * 17 - 1.8, 1.0]
    (front,), (back,) = cameras_of(sample, view, Path(), 0)
    assert (front["title"], back["title"], back["src"]) == ("front", "back", "")
    for entry, camera in ((back, sample.cameras[0]), (front, sample.cameras[1])):
        pixel = np.reshape(entry["matrix"], (3, 3)) @ [3, 17, 1]
        expected = camera.intrinsics @ (camera.cam_from_frame @ point)[:3]
        np.testing.assert_allclose(pixel, expected, rtol=1e-4)


def test_a_frame_that_looks_along_x_is_turned_to_look_up(tmp_path):
    path, results = write_case(tmp_path, frame="ego")
    data = page_data(path, results, NO_IMAGES)
    assert data["extent"] == (-30.0, 30.0, -15.0, 15.0)
    frame = data["frames"][0]
    assert frame["truth"][2]["p"] == [2000, 500, -2000, 500]  # x = 5 m ahead, y = 20 m to the left
    assert frame["found"][0][0]["g"][:3] == [200, 50, 180]


def test_texts_of_files_cannot_leave_the_block_of_data(data):
    page = page_html(data)
    block = re.search(r'id="data">(.*?)</script>', page, re.DOTALL)[1]
    assert "<" not in block
    assert json.loads(block)["results"] == ["good", STRANGE]
    assert "data:image" not in block  # each frame's images are read when it is opened
    images = re.findall(r'class="images">(.*?)</script>', page)
    assert [len(json.loads(each)) for each in images] == [2] * FRAMES
    assert page.count("data:image/jpeg") == 2 * FRAMES
    assert json.loads(block)["frames"][0]["title"].startswith(STRANGE)
    assert page.count("<img") == 0
    assert "innerHTML" not in page
    policy = re.search(r'content="(default-src[^"]*)"', page)[1]
    assert policy.startswith("default-src 'none'; img-src data:; style-src 'sha256-")
    assert policy.endswith("; base-uri 'none'; form-action 'none'")
    for tag in ("style", "script"):
        content = re.search(rf"<{tag}>(.*?)</{tag}>", page, re.DOTALL)[1]
        digest = base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
        assert f"{tag}-src 'sha256-{digest}'" in policy


def test_thumbnails_are_small_jpegs_and_a_missing_image_is_an_error(case, tmp_path):
    small = page_data(*case, PageOptions(image_width=32, max_frames=1))
    source = small["frames"][0]["cameras"][0][0]["src"]
    assert source.startswith("data:image/jpeg;base64,/9j/")
    assert len(source) < 1500
    with pytest.raises(ValueError, match=r"no readable image at .*--data-root"):
        page_data(*case, PageOptions(data_root=tmp_path))


def test_without_results_the_page_shows_ground_truth(case):
    data = page_data(case[0], {}, replace(NO_IMAGES, max_frames=2))
    assert data["title"] == "case val: ground truth"
    assert data["tables"] == data["curves"] == data["frames"][0]["found"] == []
    notes = page_data(*case, replace(NO_IMAGES, max_frames=2))["notes"]  # too few for worst ones
    assert data["notes"] == notes[-1:] == ["The page shows 2 of 6 frames: evenly spread."]


def test_results_of_other_samples_are_an_error_unless_allowed(case, tmp_path):
    other = tmp_path / "other.json"
    strange = {"cls_name": "kerb", "pts": [[0, 0], [1, 0]], "confidence_level": 0.5}
    short = {"cls_name": CLASSES[0], "pts": [[0, 0]], "confidence_level": 0.5}
    vectors = [strange, short]
    other.write_text(json.dumps({"results": [{"sample_token": "t0", "vectors": vectors}]}))
    with pytest.raises(ValueError, match=r"other\.json: 5 samples have no results"):
        page_data(case[0], {"other": other}, NO_IMAGES)
    allowed = page_data(case[0], {"other": other}, replace(NO_IMAGES, allow_mismatch=True))
    assert allowed["frames"][3]["found"] == [[]]
    assert "5 samples have no results" in allowed["notes"][0]
    assert allowed["notes"][1:] == [
        "other: 1 prediction of fewer than two points left out",
        "other: 1 predictions of class 'kerb' are not scored",
    ]


@pytest.mark.parametrize("wrong", [{"max_frames": 0}, {"score_thr": 1.2}, {"image_width": -1}])
def test_options_out_of_range_are_refused(wrong):
    with pytest.raises(ValueError, match="must be"):
        PageOptions(**wrong)


def test_gaussians_are_read_where_all_vectors_have_them(case, tmp_path):
    path = case[1]["good"]
    assert read_samples(path, RESULTS_KEY, CLASSES)[0]["t0"].scales is None
    elements = read_samples(path, RESULTS_KEY, CLASSES, gaussians=True)[0]["t0"]
    assert elements.scales.shape == (len(elements.points), 2)
    assert elements.rotations[0] == pytest.approx(np.pi / 2)
    content = json.loads(path.read_text())
    del content["results"][0]["vectors"][1]["gaussian_scales"]
    (tmp_path / "some.json").write_text(json.dumps(content))
    some = read_samples(tmp_path / "some.json", RESULTS_KEY, CLASSES, gaussians=True)[0]
    assert not some["t0"].has_gaussians
    assert some["t1"].has_gaussians


def test_the_command_writes_the_page_and_says_its_size(case, tmp_path):
    path, results = case
    out = tmp_path / "report.html"
    both = [results["good"], "--compare", results[STRANGE], "--ann", path, "--out", out]
    done = run_tool("tools/report.py", *both, "--names", "GSMap", "MapTR")
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(rf"6 frames, 0\.\d MB: {out}\n", done.stdout)
    assert "<title>case val: GSMap and MapTR</title>" in out.read_text()
    failed = run_tool("tools/report.py", *both, "--names", "GSMap")
    assert failed.returncode == 2
    assert "--names must give 2 different names" in failed.stderr
    failed = run_tool("tools/report.py", *both[:-1], tmp_path / "report.pdf")
    assert failed.returncode == 2
    assert "give a name that ends with .html or .htm or .mp4" in failed.stderr
    assert not (tmp_path / "report.pdf").exists()


def test_the_package_carries_the_page():
    config = (REPO / "pyproject.toml").read_text()
    pattern = re.search(r'"gsmap\.visualization\.page" = \["(.*)"\]', config)[1]
    carried = {
        path.name for path in (REPO / "projects/GSMap/gsmap/visualization/page").glob(pattern)
    }
    assert {"page.html", "page.css", "page.js"} <= carried


def test_changes_are_lines_of_the_frames_and_a_table(case, tmp_path):
    path = write_changes_case(tmp_path / "changes.geojson")
    data = page_data(*case, replace(NO_IMAGES, changes=path))
    for frame in data["frames"]:
        moved, removed = frame["changes"]
        assert moved == {
            "kind": "moved",
            "text": "divider moved by 1.02 \N{PLUS-MINUS SIGN} 0.05 m",
            "p": [100, -3000, 100, 3000],  # cut to the range
        }
        assert removed["text"] == "ped_crossing removed (2 of 3 drives)"
        assert removed["p"] == [round(100 * value) for point in RING for value in point]
    assert "4 changes of the map: 1 removed, 2 added, 1 moved; 2 in these frames." in data["notes"]
    table = data["tables"][-1]
    assert table["caption"] == "Changes of the map"
    rows = {tuple(row[:2]): row for row in table["rows"]}
    assert rows["divider", "moved"][3] == "1.02 \N{PLUS-MINUS SIGN} 0.05 m"
    assert rows["ped_crossing", "removed"][4] == "2 of 3"
    assert table["rows"][-1][0] == "boundary"  # the least sure
    assert "<img" not in page_html(data)


def test_a_page_without_changes_has_none(case):
    data = page_data(*case, NO_IMAGES)
    assert all(frame["changes"] == [] for frame in data["frames"])
    assert all(table["caption"] != "Changes of the map" for table in data["tables"])


@pytest.mark.parametrize(
    ("name", "value"), [("moved_m", -1.0), ("moved_std_m", "x"), ("passes_in_view", True)]
)
def test_wrong_figures_of_changes_are_named(case, tmp_path, name, value):
    path = write_changes_case(tmp_path / "changes.geojson")
    content = json.loads(path.read_text())
    content["features"][1]["properties"][name] = value
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=rf"feature 1: `{name}` must be a number of at least 0"):
        page_data(*case, replace(NO_IMAGES, changes=path))


def test_a_change_far_from_the_origin_is_at_its_place_in_the_frame_of_a_tilted_vehicle(tmp_path):
    """Changes are 2D: roll, pitch and height of the pose do not move them."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("ZYX", [0, 3, 1], degrees=True).as_matrix()
    pose[:3, 3] = 4000, 2500, 60
    annotations, _ = write_case(tmp_path)
    sample = replace(AnnotationFile(annotations)[0], global_from_frame=pose)
    content = json.loads(write_changes_case(tmp_path / "changes.geojson").read_text())
    (feature, *_) = content["features"]
    feature["geometry"]["coordinates"] = [[4000.0, 2505], [4000, 2510]]
    content["features"] = [feature]
    (tmp_path / "changes.geojson").write_text(json.dumps(content))
    file = AnnotationFile(annotations)
    layer = ChangeLayer(tmp_path / "changes.geojson", file)
    (entry,) = layer.entries(sample, FRAME_VIEWS["lidar"])
    assert entry["p"] == [0, 500, 0, 1000]
    write_annotations(annotations, replace(file.meta, options={"poses": False}), list(file))
    with pytest.raises(ValueError, match="knows no poses, which changes need"):
        ChangeLayer(tmp_path / "changes.geojson", AnnotationFile(annotations))
