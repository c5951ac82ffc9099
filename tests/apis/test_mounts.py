"""Where a model's frame lay in the vehicle of its training: at inference it lies there, too."""

import logging
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml
from inferencer_cases import make_config, make_samples
from mmdet3d.registry import DATASETS
from mmengine.registry import init_default_scope
from scipy.spatial.transform import Rotation

import gsmap.registered  # noqa: F401
from gsmap.apis.export import ExportedDetector, graph_metadata
from gsmap.apis.loading import load_model
from gsmap.apis.map_inferencer import MapInferencer
from gsmap.checkpoints.named_models import checkpoint_for
from gsmap.datasets.annotations.file import AnnotationFile, write_annotations
from gsmap.datasets.annotations.record import AnnotationMeta
from gsmap.datasets.source import Mount, change_frame, ground_from_frame
from gsmap.structures.rigid import invert_rigid, rigid
from gsmap.utils.model_facts import MOUNT, RIG
from mapdata.inputs import open_input

TILTED = Rotation.from_euler("ZYX", [-88.0, 1.5, -1.0], degrees=True).as_matrix()
CASES = {  # frame: what the file says of the road, where the record's frame lies in the vehicle
    "ego": (0.0, None),
    "lidar": (None, rigid(TILTED, [1.4, -0.1, 2.3])),
}


def upright(frame):
    """Return the turn of cameras that look along y into those that look along the frame's ahead."""
    if frame == "lidar":
        return np.eye(4)
    return rigid([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [0, 0, -1.5])  # 1.5 m above the frame


def trained(folder: Path, frame: str) -> tuple[AnnotationMeta, list, Path]:
    """Write samples of a frame, and a checkpoint of a model that was trained on them.

    Returns:
        The file's metadata, its samples, and the checkpoint.
    """
    height, ego_from_frame = CASES[frame]
    samples = make_samples(folder, 2)
    for sample in samples:
        sample.lidar, sample.ego_from_frame = None, ego_from_frame
        for camera in sample.cameras:
            camera.cam_from_frame = camera.cam_from_frame @ upright(frame)
            pixels = cv2.imread(str(folder / camera.path))
            camera.path = f"{camera.name}/{sample.token}.png"  # a file that holds the very pixels
            (folder / camera.name).mkdir(exist_ok=True)
            cv2.imwrite(str(folder / camera.path), pixels)
    meta = AnnotationMeta(
        "mine", frame, "val", x_range=(-15, 15), y_range=(-30, 30), ground_z_m=height
    )
    write_annotations(folder / "val.arrow", meta, samples)
    init_default_scope("mmdet3d")
    dataset = DATASETS.build(
        {"type": "VectorizedMapDataset", "ann_file": str(folder / "val.arrow"), "test_mode": True}
    )
    torch.manual_seed(0)
    model = MapInferencer(config_of(frame), None, device="cpu").model
    checkpoint = folder / "trained.pth"
    said = {"state_dict": model.state_dict(), "meta": {"dataset_meta": dataset.metainfo}}
    torch.save(said, checkpoint)
    return meta, list(AnnotationFile(folder / "val.arrow")), checkpoint


def config_of(frame):
    cfg = make_config()
    cfg.test_dataloader.dataset.frame = frame
    return cfg


def in_memory(sample, folder, from_given):
    """Return images, intrinsics, and cameras from a frame, given the transform from it."""
    images = {c.name: cv2.imread(str(folder / c.path))[..., ::-1] for c in sample.cameras}
    intrinsics = {c.name: c.intrinsics for c in sample.cameras}
    return images, intrinsics, {c.name: c.cam_from_frame @ from_given for c in sample.cameras}


@pytest.mark.parametrize("frame", CASES)
def test_live_and_a_folder_see_what_the_test_saw(frame, tmp_path):
    meta, samples, checkpoint = trained(tmp_path, frame)
    inferencer = MapInferencer(config_of(frame), checkpoint, device="cpu")
    expected = [found.pred_instances_3d.pts for found in inferencer(tmp_path / "val.arrow")]
    frame_from_ground = invert_rigid(ground_from_frame(samples[0], frame, meta.ground_z_m))
    close = {"atol": 1e-4, "rtol": 0}
    for given, from_given in (("vehicle", frame_from_ground), (frame, np.eye(4))):
        images, *rig = in_memory(samples[0], tmp_path, from_given)
        live = inferencer.live(*rig, frame=given)
        torch.testing.assert_close(live.predict(images).pred_instances_3d.pts, expected[0], **close)
    vehicle = inferencer.live(*in_memory(samples[0], tmp_path, frame_from_ground)[1:], "vehicle")
    moved = vehicle(in_memory(samples[0], tmp_path, np.eye(4))[0])
    points = expected[0].numpy().reshape(-1, 2)
    road = np.column_stack([points, np.zeros(len(points)), np.ones(len(points))])
    at = (ground_from_frame(samples[0], frame, meta.ground_z_m) @ road.T).T[:, :2]
    np.testing.assert_allclose(moved.points, at, atol=0.2)  # a tilt of two degrees

    write_calibration(tmp_path, samples[0], frame_from_ground)
    source = open_input(tmp_path / "calibration.yaml")
    found = inferencer(replace(source, data_root=tmp_path))
    for sample, points in zip(found, expected, strict=True):
        torch.testing.assert_close(sample.pred_instances_3d.pts, points, **close)


def write_calibration(folder, sample, frame_from_ground):
    """Write the calibration file of a folder with one folder for each camera."""
    cameras = {}
    for camera in sample.cameras:
        pose = invert_rigid(camera.cam_from_frame @ frame_from_ground)
        k = camera.intrinsics
        cameras[camera.name] = {
            "intrinsics": [float(k[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2))],
            "vehicle_from_camera": pose.tolist(),
        }
    (folder / "calibration.yaml").write_text(yaml.safe_dump({"cameras": cameras}))


@pytest.mark.parametrize("frame", CASES)
def test_the_place_of_the_frame_travels_with_the_checkpoint_and_the_onnx_file(frame, tmp_path):
    meta, samples, checkpoint = trained(tmp_path, frame)
    inferencer = MapInferencer(config_of(frame), checkpoint, device="cpu")
    wanted = ground_from_frame(samples[0], frame, meta.ground_z_m)
    np.testing.assert_allclose(inferencer.model.mount.matrix, wanted)
    said = graph_metadata(ExportedDetector(inferencer.model), ["a", "b"], (96, 160), frame)
    np.testing.assert_allclose(said["ground_from_frame"], wanted)
    assert said["ground_z_m"] == meta.ground_z_m
    own = np.eye(4) if CASES[frame][1] is None else CASES[frame][1]
    np.testing.assert_allclose(said["ego_from_frame"], own, atol=1e-12)


def test_two_vehicles_whose_roads_lie_at_other_heights_are_one(tmp_path):
    """An annotation file of another car, in the same frame but for its height."""
    _, samples, checkpoint = trained(tmp_path, "ego")
    inferencer = MapInferencer(config_of("ego"), checkpoint, device="cpu")
    expected = [found.pred_instances_3d.pts for found in inferencer(tmp_path / "val.arrow")]
    raised = rigid(np.eye(3), [0, 0, 0.31])  # its origin lies on the axle
    for sample in samples:
        for camera in sample.cameras:
            camera.cam_from_frame = camera.cam_from_frame @ raised
    write_annotations(
        tmp_path / "other.arrow", AnnotationMeta("x", "ego", "val", ground_z_m=-0.31), samples
    )
    found = inferencer(tmp_path / "other.arrow")
    for sample, points in zip(found, expected, strict=True):
        torch.testing.assert_close(sample.pred_instances_3d.pts, points, atol=1e-4, rtol=0)


def test_what_is_not_known_is_said_and_what_cannot_be_is_refused(tmp_path, caplog):
    _, _, checkpoint = trained(tmp_path, "ego")
    content = torch.load(checkpoint, weights_only=True)
    said = content["meta"]["dataset_meta"]
    usual = Mount("ego").matrix

    def opened(**changes):
        content["meta"]["dataset_meta"] = {**said, **changes}
        torch.save(content, checkpoint)
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            return MapInferencer(config_of("ego"), checkpoint, device="cpu").model.mount

    np.testing.assert_array_equal(opened(ground_z_m=None, **{MOUNT: None}).matrix, usual)
    assert "does not say how high its frame 'ego' lies above the road" in caplog.text
    opened(ground_z_m=None, dataset="av2", **{MOUNT: None})
    assert caplog.text == ""
    for wrong in (
        {MOUNT: np.diag([1.0, 1, 2, 1]).tolist()},
        {MOUNT: [[1.0]]},
        {MOUNT: "here"},
        {"ground_z_m": "high"},
        {"ground_z_m": 1e9},
        {"ground_z_m": float("nan")},
        {"ground_z_m": 10**400},
        {MOUNT: [[10**400] * 4] * 4},
        {MOUNT: rigid(np.eye(3), [1e4, 0, 0]).tolist()},
    ):
        with pytest.raises(ValueError, match="the place of its frame in the vehicle is impossible"):
            opened(**wrong)


def test_a_height_in_the_config_is_that_of_the_file(tmp_path):
    _, samples, _ = trained(tmp_path, "ego")
    settings = {"type": "VectorizedMapDataset", "ann_file": str(tmp_path / "val.arrow")}
    with pytest.raises(ValueError, match=r"road at z = 0 m of its frame, the config at -0.3 m"):
        DATASETS.build({**settings, "test_mode": True, "ground_z_m": -0.3})
    write_annotations(tmp_path / "val.arrow", AnnotationMeta("x", "ego", "val"), samples)
    old = DATASETS.build({**settings, "test_mode": True, "ground_z_m": -0.3})
    assert old.metainfo["ground_z_m"] == -0.3
    np.testing.assert_allclose(old.metainfo[MOUNT], rigid(np.eye(3), [0, 0, 0.3]))


def test_files_without_a_height_are_as_those_of_earlier_versions(tmp_path):
    _, samples, _ = trained(tmp_path, "ego")
    write_annotations(tmp_path / "a.arrow", AnnotationMeta("x", "ego", "val"), samples)
    raw = (tmp_path / "a.arrow").read_bytes()
    assert b"ground_z_m" not in raw
    assert b'"ground_z_m": 0.0' in (tmp_path / "val.arrow").read_bytes()
    for wrong in (float("nan"), 1e3):
        with pytest.raises(ValueError, match="ground_z_m must be metres"):
            AnnotationMeta("x", "ego", "val", ground_z_m=wrong)


def test_a_mounts_pose_and_its_records_pose_agree():
    for frame, (height, ego_from_frame) in CASES.items():
        mount = Mount(frame, height, None)
        np.testing.assert_allclose(
            ground_from_frame(sample_of(mount.ego_from_frame), frame, height), mount.matrix
        )
        if ego_from_frame is not None:
            mount = Mount(frame, height, ego_from_frame)
            np.testing.assert_allclose(mount.ego_from_frame, ego_from_frame)


def sample_of(ego_from_frame):
    class Sample:
        pass

    sample = Sample()
    sample.ego_from_frame = ego_from_frame
    return sample


def test_the_cameras_of_the_training_travel_with_the_checkpoint(tmp_path):
    _, samples, checkpoint = trained(tmp_path, "ego")
    content = torch.load(checkpoint, weights_only=True)
    content["meta"]["dataset_meta"][RIG]["odd"] = [1.0, "x"]
    content["meta"]["dataset_meta"][RIG]["none"] = [0.0] * 6
    content["meta"]["dataset_meta"][RIG]["huge"] = [1, 1, 1, 1, 10**400, 1]
    content["meta"]["dataset_meta"][RIG]["nan"] = [1.0, 1.0, 1.0, 1.0, float("nan"), 1.0]
    torch.save(content, checkpoint)
    model = MapInferencer(config_of("ego"), checkpoint, device="cpu").model
    camera = samples[0].cameras[0]
    assert set(model.rig) == {c.name for c in samples[0].cameras}
    assert model.rig[camera.name] == (320, 180, 250, 250, 160, 90)


def test_two_roof_lidars_are_taken_for_one():
    sample = sample_of(None)
    assert change_frame(sample, "lidar", Mount("lidar", None, CASES["lidar"][1])) is sample


def test_models_of_generated_streets_say_so_once_on_other_recordings(tmp_path, caplog):
    samples = make_samples(tmp_path, 1)
    for name in ("minicity", "mine"):
        meta = AnnotationMeta(name, "lidar", "val", x_range=(-15, 15), y_range=(-30, 30))
        write_annotations(tmp_path / f"{name}.arrow", meta, samples)
    inferencer = MapInferencer("gsmap_r18_minicity", device="cpu")
    with caplog.at_level(logging.WARNING):
        inferencer.dataset(tmp_path / "minicity.arrow")
        assert "generated streets alone" not in caplog.text
        inferencer.dataset(tmp_path / "mine.arrow")
        inferencer.dataset(open_input(tmp_path / "mine.arrow"))
    assert caplog.text.count("the model was trained on generated streets only (MiniCity)") == 1


@pytest.mark.parametrize("copied", [False, True])
def test_the_file_of_a_model_that_ships_is_of_generated_streets(copied, tmp_path):
    """Commands give the weights by their path."""
    path = checkpoint_for("gsmap_r18_minicity", None)
    if copied:
        path = Path(shutil.copy(path, tmp_path))
    model = load_model("gsmap_r18_minicity", path)
    assert model.training_dataset == "minicity"
    renamed = path if not copied else path.rename(tmp_path / "mine.pth")
    known = load_model("gsmap_r18_minicity", renamed).training_dataset
    assert known == ("" if copied else "minicity")


def test_models_of_generated_streets_say_so_once_of_images_in_memory(caplog):
    inferencer = MapInferencer("gsmap_r18_minicity", device="cpu")
    names = inferencer.cfg.test_dataloader.dataset.cameras
    intrinsics = dict.fromkeys(names, np.array([[100.0, 0, 80], [0, 100, 45], [0, 0, 1]]))
    cam_from_vehicle = np.array([[0, -1, 0, 0], [0, 0, -1, 1.5], [1, 0, 0, 0], [0, 0, 0, 1.0]])
    live = inferencer.live(intrinsics, dict.fromkeys(names, cam_from_vehicle), frame="vehicle")
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            live.predict(dict.fromkeys(names, np.zeros((90, 160, 3), np.uint8)))
    assert caplog.text.count("the model was trained on generated streets only (MiniCity)") == 1


def test_a_model_that_lifts_images_sees_live_what_it_sees_of_files(tmp_path):
    """In the frame of the LiDAR, the default, and with the place of that frame in the vehicle."""
    (sample,) = make_samples(tmp_path, 1)
    sample.lidar, sample.ego_from_frame = None, ground_from_frame(sample, "lidar")
    for camera in sample.cameras:  # a file that holds the very pixels
        image = cv2.imread(str(tmp_path / camera.path))
        camera.path = f"{camera.name}.png"
        cv2.imwrite(str(tmp_path / camera.path), image)
    inferencer = MapInferencer("gsmap_mgmapnet_r18_minicity", device="cpu")
    dataset = inferencer.dataset([sample], tmp_path)
    (expected,) = inferencer.predict(dataset, allow_missing_cameras=True)
    images, *rig = in_memory(sample, tmp_path, np.eye(4))
    live = inferencer.live(*rig, allow_missing_cameras=True)
    found = live.predict(images).pred_instances_3d
    torch.testing.assert_close(found.pts, expected.pred_instances_3d.pts, atol=1e-4, rtol=0)
