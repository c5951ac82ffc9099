"""The command that measures corruptions: its pipelines, its table, one run."""

import importlib.util
import json
from argparse import Namespace
from pathlib import Path

import pytest
import torch

from gsmap.datasets.annotations.file import write_annotations
from gsmap.datasets.annotations.record import AnnotationMeta
from mapdata.nuscenes.convert import NuScenesOptions, convert_nuscenes

FILE = "gsmap_minicity_val.arrow"
REPO = Path(__file__).resolve().parents[2]


@pytest.fixture
def tool():
    spec = importlib.util.spec_from_file_location("robustness", REPO / "tools/robustness.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_corruptions_come_right_after_the_images_and_delays_before(tool):
    load, scale = {"type": "LoadCameraImages"}, {"type": "ScaleImages"}
    settings = {"ann_file": "a.arrow", "data_root": "d", "pipeline": [load, scale]}
    fog = tool.add_corruption(settings, "fog", 3, 7)["pipeline"]
    assert fog == [load, {"type": "CorruptImages", "kind": "fog", "severity": 3, "seed": 7}, scale]
    late = tool.add_corruption(settings, "camera_delayed", 2, 7)["pipeline"]
    files = {"ann_file": "a.arrow", "data_root": "d"}
    assert late == [{"type": "DelayCameras", **files, "severity": 2, "seed": 7}, load, scale]
    assert tool.add_corruption(settings, "none", 1, 7) == settings
    with pytest.raises(
        ValueError, match=r"pipeline \['ScaleImages'\] has no step LoadCameraImages"
    ):
        tool.add_corruption({**settings, "pipeline": [scale]}, "fog", 3, 7)


class Drives:
    """Two scenes of two samples.

    Args:
        cameras: Names of the cameras of all samples but the last.
        last: Names of the cameras of the last sample.
        used: Cameras that the config names.
    """

    def __init__(self, cameras: str, last: str, used: tuple[str, ...] | None = None) -> None:
        self.names = [cameras, cameras, cameras, last]
        self.cameras = used

    def sample(self, index: int) -> Namespace:
        return Namespace(cameras=[Namespace(name=name) for name in self.names[index]])

    def scenes(self) -> list[list[int]]:
        return [[1, 0], [2, 3]]


@pytest.mark.parametrize(
    ("dataset", "indices", "lost", "delayed"),
    [
        (Drives("abcdef", "abcdef"), [0, 1, 2, 3], 5, 5),
        (Drives("abc", "abc"), [0, 1, 2, 3], 2, 2),
        (Drives("a", "a"), [0, 1, 2, 3], 0, 0),
        (Drives("abcdef", "ab"), [0, 1, 2, 3], 1, 1),
        (Drives("abcdef", "ab"), [0, 1], 5, 5),
        (Drives("abcdef", "abcdef", used=("a", "c")), [0, 3], 1, 1),
        (Drives("abcdef", ""), [3], 0, 0),
        (Drives("abcdef", "abcdef"), [1, 2], 5, 0),  # the first ones of their scenes
    ],
)
def test_as_many_cameras_fail_as_a_severity_says_or_it_has_no_figure(
    tool, dataset, indices, lost, delayed
):
    kinds = ["camera_lost", "camera_delayed", "fog"]
    found = tool.severities_of(kinds, dataset, indices)
    assert found == {"camera_lost": lost, "camera_delayed": delayed, "fog": 5}
    notes = tool.notes_on(found)
    assert len(notes) == (lost < 5) + (delayed < 5)
    for note in notes:
        assert "is left out" in note or "has no figures above severity" in note


def test_nothing_to_measure_with_one_camera_is_an_error(tool):
    severities = tool.severities_of(["camera_lost"], Drives("a", "a"), [0])
    with pytest.raises(ValueError, match=r"nothing to measure: camera_lost is left .* --kinds"):
        tool.notes_on(severities)


def test_severities_without_figures_are_dashes(tool, tmp_path):
    from gsmap.visualization.plots import plot_severities

    lost = [{"mean": 30.0}, {"mean": 20.0}]
    found = {"none": [{"mean": 40.0}], "camera_lost": lost}
    assert "| camera_lost | 30.0 | 20.0 | - | - | - | - |" in tool.table(found)
    assert tool.are_figures(found)
    assert not tool.are_figures({**found, "camera_lost": []})
    assert not tool.are_figures({**found, "fog": lost})
    (line,) = plot_severities({"camera_lost": [30.0, 20.0]}, 40.0, tool.SEVERITIES).axes[0].lines
    assert line.get_xdata().tolist() == [0, 1, 2]


def test_a_model_without_cameras_is_refused(tool, tmp_path, monkeypatch):
    (tmp_path / "a.pth").touch()
    monkeypatch.setattr(
        "gsmap.apis.loading.load_model", lambda *_, **__: Namespace(img_backbone=None)
    )
    words = ["maptr_pointpillars_minicity", str(tmp_path / "a.pth"), "--out", str(tmp_path / "r")]
    monkeypatch.setattr("sys.argv", ["robustness.py", *words])
    with pytest.raises(ValueError, match="maptr_pointpillars_minicity uses no images to corrupt"):
        tool.main()


def test_every_kind_is_registered_and_in_the_table(tool):
    from gsmap.datasets.transforms.corruptions import KINDS, SEVERITIES

    assert set(tool.KINDS) == {*KINDS, "camera_delayed"}
    assert tool.SEVERITIES == SEVERITIES
    found = {"none": [{"mean": 40.0}], "fog": [{"mean": v} for v in (40.0, 30.0, 20.0, 10.0, 0.0)]}
    assert "| fog | 40.0 | 30.0 | 20.0 | 10.0 | 0.0 | 50 % |" in tool.table(found)
    found["none"] = [{"mean": 0.0}]  # of which no AP is a share
    assert "| 0.0 | - |" in tool.table(found)


@pytest.mark.parametrize(
    ("model", "samples"),
    [("gsmap_r18_minicity", ["--samples", "2"]), ("gsmap_stream_finetune_r18_minicity", [])],
    ids=["single frames", "a memory, empty at the start of each corruption"],
)
def test_a_run_writes_table_figures_and_plot(
    tool, minicity_root, tmp_path, monkeypatch, model, samples
):
    options = {"dataset": "minicity", "out_dir": tmp_path}
    convert_nuscenes(NuScenesOptions(minicity_root, "v1.0-trainval", **options))
    words = [model, "--data-root", str(minicity_root), *samples]
    options = ["--kinds", "camera_lost", "camera_delayed", "camera_lost", "--out", str(tmp_path)]
    options += ["--cfg-options", f"test_dataloader.dataset.ann_file={tmp_path}/{FILE}"]
    monkeypatch.setattr("sys.argv", ["robustness.py", *words, *options])
    monkeypatch.setattr(tool, "SEVERITIES", (1, 5))
    said = tool.main()
    found = json.loads((tmp_path / "robustness.json").read_text())
    assert {kind: len(figures) for kind, figures in found.items()} == {
        "none": 1, "camera_lost": 2, "camera_delayed": 2,
    }  # fmt: skip
    assert (tmp_path / "robustness.md").read_text() in said
    assert (tmp_path / "robustness.png").stat().st_size > 1000


def test_figures_of_earlier_runs_into_a_folder_are_kept(tool, tmp_path):
    path = tmp_path / "robustness.json"
    assert tool.earlier_figures(path) == {}
    clean, other, seed = ([{"mean": m, "seed": s}] for m, s in ((40.0, 0), (41.0, 0), (40.0, 1)))
    rows = [{"mean": 20.0}] * 5
    path.write_text(json.dumps({"none": [{"mean": 40.0}], "fog": rows, "jpeg": rows}))
    before = tool.earlier_figures(path)
    args = Namespace(out=tmp_path, kinds=["jpeg", "rain"])
    assert tool.other_figures(before, clean, args) == {"fog": rows}
    with pytest.raises(ValueError, match=r"has figures of fog of another model, .* give another"):
        tool.other_figures(before, other, args)
    with pytest.raises(ValueError, match=r"without corruption and seed 0, here 40.0 and 1\): give"):
        tool.other_figures(before, seed, args)
    assert tool.other_figures(before, other, Namespace(out=tmp_path, kinds=["fog", "jpeg"])) == {}
    for wrong in ("[]", "{}", '{"none": [{"mean": 1.0}], "mist": []}', '{"none": [{"mean": "a"}]}'):
        path.write_text(wrong)
        with pytest.raises(ValueError, match=r"robustness.json holds no figures of this command"):
            tool.earlier_figures(path)


def test_data_of_another_split_is_refused_unless_allowed(tool, tmp_path, monkeypatch):
    here, other = ("near@" + digit * 16 for digit in "01")
    meta = AnnotationMeta("minicity", "lidar", "val", options={"split_list": here})
    write_annotations(tmp_path / "a.arrow", meta, [])
    state = {"weight": torch.ones(1)}
    settings = {"data_root": str(tmp_path), "ann_file": "a.arrow"}
    for dataset, split in (("minicity", here), ("nuscenes", other), ("minicity", other)):
        trained = {"dataset": dataset, "split_list": split}
        torch.save({"state_dict": state, "meta": {"dataset_meta": trained}}, tmp_path / "a.pth")
        if (dataset, split) != ("minicity", other):
            tool.require_own_split(tmp_path / "a.pth", settings)
    with pytest.raises(ValueError, match=f"a.pth was trained on the split {other}, .* to {here}"):
        tool.require_own_split(tmp_path / "a.pth", settings)


def test_no_samples_are_refused_at_once(tool, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["robustness.py", "a", "--samples", "0", "--out", "b"])
    with pytest.raises(SystemExit):
        tool.main()
    assert "--samples must be >= 1, got 0" in capsys.readouterr().err
