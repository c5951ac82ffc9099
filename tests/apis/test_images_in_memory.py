"""Images in memory, one sample and live, on a small MapTR with random weights."""

import copy
import pickle
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier

import cv2
import numpy as np
import pytest
import torch
from inferencer_cases import drive, make_remembering, make_samples
from scipy.spatial.transform import Rotation

from gsmap.datasets.source import Source, change_frame, ground_from_frame
from gsmap.structures.rigid import invert_rigid, rigid
from gsmap.structures.streams import Frame
from gsmap.visualization.figure import figure_to_rgb


def in_memory(sample, folder):
    """Return a sample's images (RGB), intrinsics and cam_from_frame, by camera."""
    images = {c.name: cv2.imread(str(folder / c.path))[..., ::-1] for c in sample.cameras}
    intrinsics = {c.name: c.intrinsics for c in sample.cameras}
    return images, intrinsics, {c.name: c.cam_from_frame for c in sample.cameras}


def test_images_in_memory_give_what_their_files_give(inferencer, tmp_path):
    (sample,) = make_samples(tmp_path, 1)
    for camera in sample.cameras:  # a file that holds the very pixels
        image = cv2.imread(str(tmp_path / camera.path))
        camera.path = f"{camera.name}.png"
        cv2.imwrite(str(tmp_path / camera.path), image)
    (expected,) = inferencer([sample], tmp_path)
    arrays = in_memory(sample, tmp_path)
    found = inferencer.predict_images(*arrays)
    torch.testing.assert_close(found.pred_instances_3d.pts, expected.pred_instances_3d.pts)
    assert figure_to_rgb(inferencer.draw(found, score_thr=0.0)).shape[1] == 400
    assert len(inferencer.visualizer.cameras(found.metainfo)) == 2
    lines = inferencer.elements(found)
    np.testing.assert_array_equal(lines.points.reshape(-1, 20, 2), found.pred_instances_3d.pts)
    # as a list, turned round: each camera is the model's that looks as it does
    listed = inferencer.predict_images(*(list(by_name.values())[::-1] for by_name in arrays))
    torch.testing.assert_close(
        listed.pred_instances_3d.pts, expected.pred_instances_3d.pts, atol=1e-3, rtol=0
    )
    vehicle = change_frame(sample, "lidar", "ego")
    (seen,) = inferencer([change_frame(vehicle, "ego", "lidar")], tmp_path)
    found = inferencer.predict_images(*in_memory(vehicle, tmp_path), frame="ego")
    torch.testing.assert_close(found.pred_instances_3d.pts, seen.pred_instances_3d.pts)


def test_a_drive_in_memory_leaves_no_files_and_its_images_as_they_are(inferencer, tmp_path):
    (sample,) = make_samples(tmp_path, 1)
    arrays = in_memory(sample, tmp_path)
    before = {name: image.copy() for name, image in arrays[0].items()}
    scratch = Path(inferencer._scratch.name)
    files = sorted(scratch.rglob("*"))
    inferencer.predict_images(*arrays)
    assert sorted(scratch.rglob("*")) == files
    for name, image in before.items():
        np.testing.assert_array_equal(arrays[0][name], image)


def test_a_live_rig_sees_each_frame_as_if_it_were_alone(inferencer, tmp_path, monkeypatch):
    opened = []
    dataset = inferencer.dataset
    monkeypatch.setattr(inferencer, "dataset", lambda s: opened.append(s) or dataset(s))
    frames = [in_memory(sample, tmp_path) for sample in make_samples(tmp_path, 3)]
    live = inferencer.live(*frames[0][1:])
    found = [live(images) for images, *_ in frames]
    assert len(opened) == 1  # the calibration is fitted once
    for elements, frame in zip(found, frames, strict=True):
        alone = inferencer.elements(inferencer.predict_images(*frame))
        np.testing.assert_array_equal(elements.points, alone.points)
        np.testing.assert_array_equal(elements.scores, alone.scores)
    assert abs(found[0].points - found[1].points).max() > 1e-3  # the images matter
    small = {name: image[::2, ::2] for name, image in frames[0][0].items()}
    alone = inferencer.elements(inferencer.predict_images(small, *frames[0][1:]))
    np.testing.assert_array_equal(live(small).points, alone.points)  # of another size


def test_threads_that_share_a_live_rig_get_maps_of_their_images(inferencer, tmp_path, monkeypatch):
    frames = [in_memory(sample, tmp_path) for sample in make_samples(tmp_path, 2)]
    live = inferencer.live(*frames[0][1:])
    alone = [live(images).points for images, *_ in frames]
    assert abs(alone[0] - alone[1]).max() > 1e-3
    predict = inferencer.predict

    def slowly(*args, **options):
        time.sleep(0.1)  # in which the other thread begins its frame
        return predict(*args, **options)

    monkeypatch.setattr(inferencer, "predict", slowly)
    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(lambda frame: live(frame[0]).points, frames))
    np.testing.assert_array_equal(found, alone)


def test_a_copy_of_a_live_rig_predicts_as_well(inferencer, tmp_path):
    images, *rig = in_memory(*make_samples(tmp_path, 1), tmp_path)
    live = inferencer.live(*rig)
    early = copy.deepcopy(live)
    alone = live(images).points
    for copied in (early, copy.copy(live), pickle.loads(pickle.dumps(live))):
        np.testing.assert_array_equal(copied(images).points, alone)


def test_threads_that_open_samples_at_once_write_files_of_their_own(
    inferencer, tmp_path, monkeypatch
):
    samples = make_samples(tmp_path, 2)
    sources = [Source([sample], frame="lidar", data_root=tmp_path) for sample in samples]
    both = Barrier(2)
    monkeypatch.setattr(inferencer, "_warn_about_real_images", lambda source: both.wait(10))
    with ThreadPoolExecutor(2) as pool:
        files = list(pool.map(lambda source: inferencer.dataset(source).ann_file, sources))
    assert len(set(files)) == 2


def test_a_live_rig_takes_the_signals_of_the_vehicle(inferencer, tmp_path):
    (sample,) = make_samples(tmp_path, 1)
    images, *rig = in_memory(sample, tmp_path)
    sample.can_bus = np.linspace(-2, 2, 18)
    (expected,) = inferencer([sample], tmp_path)
    live = inferencer.live(*rig)
    standing = live.predict(images).pred_instances_3d.pts
    found = live.predict(images, sample.can_bus).pred_instances_3d.pts
    torch.testing.assert_close(found, expected.pred_instances_3d.pts)
    assert (found - standing).abs().max() > 1e-3  # the signals matter
    torch.testing.assert_close(live.predict(images).pred_instances_3d.pts, standing)
    with pytest.raises(ValueError, match="can_bus must hold 18 values, got shape"):
        live(images, np.zeros(4))
    with pytest.raises(ValueError, match="can_bus must be finite"):
        live(images, np.full(18, np.nan))


def test_missing_signals_are_named_once_if_the_model_was_trained_with_signals(
    inferencer, tmp_path, caplog
):
    (sample,) = make_samples(tmp_path, 1)
    images, *rig = in_memory(sample, tmp_path)
    inferencer.live(*rig).predict(images)  # of no known training
    assert "vehicle signals" not in caplog.text
    inferencer.cfg.test_dataloader.dataset.signals_from_poses = True
    live = inferencer.live(*rig)
    live.predict(images, np.zeros(18))
    assert "vehicle signals" not in caplog.text
    for _ in range(2):
        live.predict(images)
    assert caplog.text.count("trained with vehicle signals") == 1


def test_given_signals_are_not_used_by_a_model_that_was_trained_without(
    inferencer, tmp_path, caplog, monkeypatch
):
    (sample,) = make_samples(tmp_path, 1)
    images, *rig = in_memory(sample, tmp_path)
    monkeypatch.setitem(inferencer.cfg.test_dataloader.dataset, "zero_signals", True)
    live = inferencer.live(*rig)
    standing = live.predict(images).pred_instances_3d.pts
    assert "vehicle signals" not in caplog.text
    for _ in range(2):
        found = live.predict(images, np.arange(18.0)).pred_instances_3d.pts
        assert torch.equal(found, standing)
    assert caplog.text.count("without vehicle signals: can_bus is not used") == 1


def test_a_live_rig_continues_a_stream_as_the_drive_does(inferencer, tmp_path):
    """The calibration is that of the vehicle, and so is the pose; the model's is the LiDAR."""
    samples, remembering = drive(tmp_path, 2), make_remembering()
    for sample in samples:
        for camera in sample.cameras:  # a file that holds the very pixels
            image = cv2.imread(str(tmp_path / camera.path))
            camera.path = f"{sample.token}_{camera.name}.png"
            cv2.imwrite(str(tmp_path / camera.path), image)
    turned = rigid([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [5, 0, 0])
    samples[1].global_from_frame = samples[1].global_from_frame @ turned
    whole = [found.pred_instances_3d.pts for found in remembering(samples, tmp_path)]
    ground_from_lidar = ground_from_frame(samples[0], "lidar")
    lidar_from_ground = np.linalg.inv(ground_from_lidar)
    _, intrinsics, cams = in_memory(samples[0], tmp_path)
    mounting = {name: cam @ lidar_from_ground for name, cam in cams.items()}
    live, stream = remembering.live(intrinsics, mounting, "vehicle"), remembering.new_stream()
    places = [
        Frame(s.token, s.scene, s.timestamp_ns, s.global_from_frame @ lidar_from_ground)
        for s in samples
    ]
    images = [in_memory(sample, tmp_path)[0] for sample in samples]
    for pixels, at, expected in zip(images, places, whole, strict=True):
        found = live.predict(pixels, at=at, stream=stream)
        assert found.metainfo["token"] == at.token
        torch.testing.assert_close(found.pred_instances_3d.pts, expected, atol=1e-3, rtol=0)
    alone = live.predict(images[1]).pred_instances_3d.pts  # a first frame
    assert (alone - whole[1]).abs().max() > 1e-2
    with pytest.raises(ValueError, match=r"'scene0' .* comes too late: its stream is at 'scene1'"):
        live(images[0], at=places[0], stream=stream)
    with pytest.raises(ValueError, match=r"needs both at=Frame\(\.\.\.\) and stream=\.\.\., got"):
        live(images[0], stream=stream)
    plain = inferencer.live(intrinsics, mounting, "vehicle")
    with pytest.raises(ValueError, match="the model has no memory"):
        plain(images[0], at=places[0], stream=stream)


def test_a_live_rig_doubts_poses_that_no_vehicle_has(tmp_path, caplog):
    remembering = make_remembering()
    (sample,) = make_samples(tmp_path, 1)
    images, intrinsics, cams = in_memory(sample, tmp_path)
    for change, is_wrong in ((np.asarray, False), (invert_rigid, True)):
        caplog.clear()
        live, stream = remembering.live(intrinsics, cams, "lidar"), remembering.new_stream()
        for number in range(25):
            turn = Rotation.from_euler("z", 40, degrees=True).as_matrix()
            pose = rigid(turn, turn @ [5, 2 * number, 0])  # straight on; y is ahead
            live.predict(
                images, at=Frame(str(number), "drive", number * 10**9, change(pose)), stream=stream
            )
        assert caplog.text.count("poses: ") == is_wrong
        assert ("only if the poses are inverted, in drive 'drive'" in caplog.text) == is_wrong


def test_a_live_map_is_in_the_frame_of_its_calibration(inferencer, tmp_path):
    """The vehicle's frame is that of nuScenes: its LiDAR 0.94 m ahead, 1.84 m up."""
    (sample,) = make_samples(tmp_path, 1)
    images, intrinsics, cam_from_lidar = in_memory(sample, tmp_path)
    in_lidar = inferencer.live(intrinsics, cam_from_lidar)(images)
    ground_from_lidar = ground_from_frame(sample, "lidar")
    np.testing.assert_array_equal(ground_from_lidar[:3, 3], [0.94, 0, 1.84])
    lidar_from_ground = np.linalg.inv(ground_from_lidar)
    cam_from_vehicle = {name: cam @ lidar_from_ground for name, cam in cam_from_lidar.items()}
    found = inferencer.live(intrinsics, cam_from_vehicle, "vehicle")(images)
    x, y = in_lidar.points.T
    np.testing.assert_allclose(found.points, np.stack([y + 0.94, -x], 1), atol=1e-3)
    vehicle = change_frame(sample, "lidar", "ego")  # 0.31 m above the road, on the same axle
    found = inferencer.live(*in_memory(vehicle, tmp_path)[1:], "ego")(images)
    np.testing.assert_allclose(found.points, np.stack([y + 0.94, -x], 1), atol=1e-3)


def test_an_absent_camera_in_memory_is_an_error_or_blank(inferencer, tmp_path):
    (sample,) = make_samples(tmp_path, 1)
    del sample.cameras[0]
    arrays = in_memory(sample, tmp_path)
    with pytest.raises(ValueError, match=r"lacks the cameras \['CAM_FRONT'\]"):
        inferencer.predict_images(*arrays)
    found = inferencer.predict_images(*arrays, allow_missing_cameras=True)
    assert found.metainfo["cam_names"] == ["CAM_BACK"]


def test_a_live_rig_may_lose_a_camera_and_get_it_back(inferencer, tmp_path):
    images, *rig = in_memory(*make_samples(tmp_path, 1), tmp_path)
    live = inferencer.live(*rig, allow_missing_cameras=True)
    whole = live(images).points
    left = {"CAM_BACK": images["CAM_BACK"]}
    alone = inferencer.predict_images(
        left, *({"CAM_BACK": part["CAM_BACK"]} for part in rig), allow_missing_cameras=True
    )
    np.testing.assert_array_equal(live(left).points, inferencer.elements(alone).points)
    np.testing.assert_array_equal(live(images).points, whole)
    with pytest.raises(ValueError, match=r"must have the cameras of the images, \['CAM_BACK'\]"):
        inferencer.live(*rig)(left)
    with pytest.raises(ValueError, match=r"\['roof'\], got \['CAM_FRONT', 'CAM_BACK'\]"):
        live({"roof": images["CAM_BACK"]})


@pytest.mark.parametrize(
    ("which", "value", "error", "text"),
    [
        (0, np.zeros((4, 6, 3)), TypeError, "image of 'CAM_BACK' must be uint8, RGB, got float64"),
        (0, np.zeros((4, 6), np.uint8), ValueError, r"'CAM_BACK' must have shape \(H, W, 3\)"),
        (1, np.eye(4), ValueError, r"CAM_BACK: intrinsics must be numbers of shape \(3, 3\)"),
        (1, np.zeros((3, 3)), ValueError, "intrinsics must be finite, with focal lengths > 0"),
        (2, np.ones((4, 4)), ValueError, "cam_from_frame is no rigid transform"),
        (2, None, ValueError, r"cam_from_frame must have the cameras of the images"),
    ],
)
def test_wrong_arrays_are_refused(inferencer, tmp_path, which, value, error, text):
    arrays = in_memory(make_samples(tmp_path, 1)[0], tmp_path)
    arrays[which]["CAM_BACK"] = value
    if value is None:
        del arrays[which]["CAM_BACK"]
    with pytest.raises(error, match=text):
        inferencer.predict_images(*arrays)


def test_a_foreign_camera_or_frame_in_memory_is_refused(inferencer, tmp_path):
    arrays = in_memory(make_samples(tmp_path, 1)[0], tmp_path)
    with pytest.raises(ValueError, match=r"one of \('vehicle', 'lidar', 'ego'\), got 'world'"):
        inferencer.predict_images(*arrays, frame="world")
    for by_name in arrays:
        by_name["roof"] = by_name.pop("CAM_BACK")
    with pytest.raises(ValueError, match=r"has the cameras .* but not \['roof'\]: name all"):
        inferencer.predict_images(*arrays)
