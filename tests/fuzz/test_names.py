"""Names that files bring lead nowhere: of scenes, cameras, topics and splits."""

import json
import shutil
import sqlite3
from dataclasses import replace
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from bag_cases import Recorder, record

from fuzz.mutations import damaged_column, write
from gsmap.datasets.annotations.file import AnnotationFile, write_annotations
from gsmap.evaluation.core.results_json import write_results
from mapdata.inputs import open_input
from mapdata.nuscenes.convert import NuScenesOptions, convert_nuscenes
from mapdata.options import InputOptions
from tools.build_map import main as build_map


class Chosen:
    """Stands for random numbers that choose one thing."""

    def __init__(self, name: str) -> None:
        self.name = name

    def choice(self, of: tuple) -> object:
        return 1 if isinstance(of[0], int) else self.name


def files_in(folder: Path) -> set[Path]:
    return {path.relative_to(folder) for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def drive(minicity_annotations):
    return list(AnnotationFile(minicity_annotations["val"]))


def test_a_scene_of_an_annotation_file_names_no_file_elsewhere(
    tmp_path, drive, minicity_annotations
):
    precious = tmp_path / "precious.geojson"
    precious.write_text("keep me")
    meta = AnnotationFile(minicity_annotations["val"]).meta
    words = [str(tmp_path / "r.json"), "--ann", str(tmp_path / "a.arrow")]
    words += ["--out", str(tmp_path / "maps")]
    write_results(tmp_path / "r.json", [(sample.token, []) for sample in drive])
    write_annotations(tmp_path / "a.arrow", meta, drive)
    content = (tmp_path / "a.arrow").read_bytes()
    for name in (str(tmp_path / "precious"), "../precious"):
        write(tmp_path / "a.arrow", damaged_column("scene")(content, Chosen(name)))
        with pytest.raises(ValueError, match=r"a\.arrow is damaged: .*would lead out of a folder"):
            build_map(words)
    assert files_in(tmp_path) == {Path(n) for n in ("precious.geojson", "r.json", "a.arrow")}
    write_annotations(tmp_path / "a.arrow", meta, [replace(s, scene="day/1") for s in drive])
    build_map(words)
    (made,) = (tmp_path / "maps").glob("*.geojson")
    assert made.name.startswith("day_1-")
    assert precious.read_text() == "keep me"


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        *product(["ros1", "sqlite", "mcap"], ["..", "a\\..", "\x1b[2J"]),
        ("sqlite", "cam/"),  # rosbags itself removes it from ROS 1
        ("mcap", "cam/"),
    ],
)
def test_a_topic_of_a_bag_names_no_file_elsewhere(tmp_path, drive, minicity_root, kind, name):
    """``/cam//image_raw`` has a camera without a name; its images went to the root folder."""
    recorder = Recorder(tmp_path / "drive", kind)
    camera = replace(drive[0].cameras[0], name=name)
    record(recorder, [replace(drive[0], cameras=[camera])], minicity_root)
    before = files_in(tmp_path)
    with pytest.raises(ValueError, match=r"drive(\.bag)? cannot be used: .*camera's name"):
        open_input(recorder.path, InputOptions(frames_dir=tmp_path / "a/frames"))
    assert files_in(tmp_path) == before
    assert not list(Path("/").glob(f"{drive[0].timestamp_ns}*"))


@pytest.mark.parametrize("name", ["../../x", "/abs/x", "..", ""])
def test_a_camera_of_a_calibration_names_no_file_elsewhere(tmp_path, name):
    folder = tmp_path / "drive"
    folder.mkdir()
    cv2.imwrite(str(folder / "a.png"), np.full((90, 160, 3), 99, np.uint8))
    camera = {
        "images": "a.png", "intrinsics": [100, 100, 80, 45], "distortion": [-0.2, 0.05, 0, 0],
        "position_m": [0, 0, 1], "yaw_pitch_roll_deg": [0, 0, 0],
    }  # fmt: skip
    (folder / "calibration.yaml").write_text(yaml.safe_dump({"cameras": {name: camera}}))
    options = InputOptions(frames_dir=tmp_path / "frames")
    with pytest.raises(ValueError, match=r"calibration\.yaml cannot be used: .*camera's name"):
        open_input(folder, options)
    assert len(files_in(tmp_path)) == 2
    (folder / "calibration.yaml").write_text(yaml.safe_dump({"cameras": {"left/front": camera}}))
    source = open_input(folder, options)
    (path,) = files_in(source.data_root)
    assert path.parts[0].startswith("left_front-")
    assert source.samples[0].cameras[0].path == path.as_posix()


def test_a_split_of_a_split_file_names_no_file_elsewhere(tmp_path, minicity_root):
    scenes = json.loads((minicity_root / "v1.0-trainval/scene.json").read_text())
    splits = {"/../../x": [scenes[0]["name"]], "val": [scene["name"] for scene in scenes[1:]]}
    (tmp_path / "splits.json").write_text(json.dumps(splits))
    out = tmp_path / "a/b/c"
    (out / "gsmap_minicity_").mkdir(parents=True)  # the way that the name would take
    convert_nuscenes(
        NuScenesOptions(minicity_root, "v1.0-trainval", dataset="minicity", out_dir=out,
                        split_file=tmp_path / "splits.json")
    )  # fmt: skip
    assert {path.parent.name for path in tmp_path.rglob("*.arrow")} == {"c"}
    assert len(list(out.glob("gsmap_minicity_*.arrow"))) == 2


@pytest.mark.parametrize(
    "definition",
    [
        "string A=\"'); open({marker!r}, 'w'); ('\"\n",
        'uint8 x\n"""\nopen({marker!r}, \'w\')\n',
        "uint8 x = __import__('os').system('touch {marker}')\n",
        "MSG: a/b\n    open({marker!r}, 'w')\nuint8 x\n",
    ],
)
@pytest.mark.parametrize("place", ["type", "definition"])
def test_message_definitions_of_a_bag_run_nothing(
    tmp_path, drive, minicity_root, definition, place
):
    """The reader of bags makes Python classes of the definitions that a bag holds."""
    recorder = Recorder(tmp_path / "drive", "sqlite")
    record(recorder, drive[:1], minicity_root)
    (path,) = recorder.path.glob("*.db3")
    text = definition.format(marker=str(tmp_path / "marker"))
    column = {"type": "topic_type", "definition": "encoded_message_definition"}[place]
    with sqlite3.connect(path) as base:
        base.execute(f"UPDATE message_definitions SET {column} = ?", (text,))
        if place == "type":
            base.execute("UPDATE topics SET type = ?", (text,))
    with pytest.raises(ValueError, match=f"{path.name} cannot be used: "):
        open_input(path, InputOptions(frames_dir=tmp_path / "frames"))
    shutil.rmtree(recorder.path)
    assert list(tmp_path.iterdir()) == []
