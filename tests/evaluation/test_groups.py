"""AP of parts of the samples: equal to that of the parts evaluated alone."""

import json

import pytest
from test_bootstrap import drive, rare_crossings, reports_of
from test_files import annotated, command, results_of

from gsmap.evaluation.analysis.groups import Groups, ap_by_group, group_table, read_groups
from gsmap.evaluation.core.results_json import write_results
from gsmap.utils.words import markdown_table

SCENES = [
    {"name": "s0", "description": "Night, rain, parked cars"},
    {"name": "s1", "description": "MiniCity, clear"},
    {"name": "s2", "description": "Turn left, train station"},
    {"name": "s3", "description": "Night, difficult lighting, after rain"},
    {"name": "s4", "description": "Rain"},
]


def test_the_ap_of_a_group_is_that_of_its_samples_alone():
    samples = drive(0, 0.6)
    groups = Groups({token: str(int(token[1:]) % 4) for token, *_ in samples})
    reports = reports_of(samples)
    found = ap_by_group(reports, groups)
    assert list(found) == ["0", "1", "2", "3"]
    for name, figures in found.items():
        wanted = {}
        for report in reports_of([s for s in samples if groups.group_of[s[0]] == name]):
            wanted |= report.metrics
        for key, value in figures.items():
            if value == -1 and key.startswith("chamfer"):
                assert wanted[f"{key.rpartition('/')[0]}/num_gts"] == 0
            else:
                assert value == pytest.approx(wanted[key], abs=1e-12), (name, key)
    assert {"chamfer/mAP", "chamfer_hard/mAP", "raster/line/AP@0.5"} <= set(found["0"])
    head, rows = group_table(reports, groups, found)
    assert head[:4] == ["", "samples", "chamfer mAP", "chamfer divider"]
    assert [row[:2] for row in rows] == [["0", "4"], ["1", "4"], ["2", "4"], ["3", "3"]]
    assert rows[1][2] == f"{100 * found['1']['chamfer/mAP']:.1f}"


def test_a_class_that_a_group_lacks_has_no_ap_there():
    samples = rare_crossings(found=3)
    reports = reports_of(samples)
    groups = Groups({token: scene for token, scene, *_ in samples})
    found = ap_by_group(reports, groups)
    head, rows = group_table(reports, groups, found)
    for metric in ("chamfer", "chamfer_hard", "raster"):
        assert found["s0"][f"{metric}/ped_crossing/AP"] == pytest.approx(1)
        assert found["s1"][f"{metric}/ped_crossing/AP"] == -1
        assert found["s1"][f"{metric}/mAP"] == pytest.approx(1)
        column = head.index(f"{metric} ped_crossing")
        assert [row[column] for row in rows] == ["100.0", "-", "-"]


def test_groups_are_scenes_maps_or_what_a_file_says(tmp_path):
    truth = annotated(tmp_path / "val.arrow", 10, scenes=5)
    assert read_groups(truth, "map").names == ["town"]
    assert read_groups(truth, "scene").group_of["t7"] == "s2"
    (tmp_path / "scene.json").write_text(json.dumps(SCENES))
    found = read_groups(truth, str(tmp_path / "scene.json")).group_of
    names = [found[f"t{i}"] for i in range(5)]
    assert names == ["night, rain", "clear", "day", "night, rain", "rain"]
    own = {f"s{i}": "odd" if i % 2 else "even" for i in range(5)}
    (tmp_path / "own.json").write_text(json.dumps(own))
    assert read_groups(truth, str(tmp_path / "own.json")).group_of["t8"] == "odd"
    each = {f"t{i}": "first" if i < 3 else "other" for i in range(10)}
    (tmp_path / "each.json").write_text(json.dumps(each))
    assert read_groups(truth, str(tmp_path / "each.json")).group_of == each


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"s0": "a"}, "has no scene 's1'"),
        ({"t0": "a", "t1": "b"}, "has no sample 't2'"),
        ({f"s{i}": 3 for i in range(5)}, "is neither an object with the group of each scene"),
        ({f"s{i}": "a\x1b[2J" for i in range(5)}, "is neither"),
        ({f"s{i}": "a" * 81 for i in range(5)}, "in at most 80 characters"),
        ([1, 2], "nor a scene.json of nuScenes"),
        ("word", "is neither"),
    ],
)
def test_a_file_without_a_group_for_each_scene_is_refused(content, message, tmp_path):
    truth = annotated(tmp_path / "val.arrow", 10, scenes=5)
    (tmp_path / "own.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=message):
        read_groups(truth, str(tmp_path / "own.json"))
    with pytest.raises(ValueError, match="knows no scenes"):
        read_groups(tmp_path / "truth.json", "scene")
    with pytest.raises(ValueError, match="the group of sample 't1' is not known"):
        Groups({"t0": "a"}).draw_copies(["t0", "t1"])


def test_a_separator_in_the_name_of_a_group_is_escaped():
    assert markdown_table(["a|b"], [["c"]]) == "| a\\|b |\n| --- |\n| c |"


def test_the_command_prints_and_writes_the_ap_of_each_group(tmp_path, capsys):
    truth = annotated(tmp_path / "val.arrow", 8, scenes=2)  # rings are found in s1; no boundaries
    write_results(tmp_path / "a.json", results_of(8))
    words = [str(tmp_path / "a.json"), str(truth), "--out", str(tmp_path / "m.json")]
    command()([*words, "--by", "scene", "--eval", "chamfer", "--against", words[0]])
    text = capsys.readouterr().out
    assert "| s0 | 4 | 50.0 | 100.0 | 0.0 | - |" in text
    assert "| s1 | 4 | 100.0 | 100.0 | 100.0 | - |" in text
    found = json.loads((tmp_path / "m.json").read_text())
    assert found["by/s1/chamfer/ped_crossing/AP"] == 1.0
    assert found["by/s0/chamfer/ped_crossing/AP"] == 0.0
