"""The data set on a generated MiniCity: what it hands on, and what it says of bad input."""

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from dataset_cases import CONFIGS, DEPTH_AND_MASKS, MINICITY, SWEEPS, dataset_config
from height_cases import write_raised
from mmengine.config import Config

from gsmap.datasets.annotations.file import AnnotationFile, write_annotations
from gsmap.datasets.source import open_annotations
from gsmap.structures.calibration import without_history

CAMERAS = (
    "CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_FRONT_LEFT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_BACK_RIGHT",
)  # fmt: skip


def test_a_training_sample_is_packed_as_the_contract_says(
    build, minicity_root, minicity_annotations
):
    data = build(**dataset_config(MINICITY, "train_dataloader", minicity_root))[0]
    meta, truth = data["data_samples"].metainfo, data["data_samples"].gt_instances_3d
    assert data["inputs"]["img"].shape == (6, 3, 90, 160)
    assert data["inputs"]["img"].dtype == torch.float32
    assert meta["cam_names"] == list(CAMERAS)
    assert meta["img_shape"] == (90, 160)
    count = len(truth)
    assert truth.pts.shape == (count, 20, 2)
    assert truth.pts_shifts.shape == (count, 19, 20, 2)
    assert truth.boxes.shape == (count, 4)
    assert truth.labels_3d.dtype == torch.int64
    assert truth.closed.tolist() == [label == 1 for label in truth.labels_3d.tolist()]
    np.testing.assert_array_equal(meta["eval_ann_info"]["labels"], truth.labels_3d)
    ends = truth.pts[:, [0, -1]]
    wanted = [line[[0, -1]] for line in meta["eval_ann_info"]["polylines"]]
    np.testing.assert_allclose(ends, wanted, atol=1e-5)
    for name in ("lidar2img", "cam2img", "lidar2cam", "img_aug_matrix"):
        assert meta[name].shape == (6, 4, 4)
    np.testing.assert_allclose(meta["img_aug_matrix"][0], np.diag([0.4, 0.4, 1, 1]))
    np.testing.assert_allclose(
        meta["lidar2img"][2],
        meta["img_aug_matrix"][2] @ meta["cam2img"][2] @ meta["lidar2cam"][2],
    )


def test_the_motion_since_the_last_frame_is_zero_as_of_single_frames(
    build, minicity_root, minicity_annotations, tmp_path
):
    """Of 1 to 18: position (entries 0 to 2) and change of yaw (the last) are left out."""
    source = AnnotationFile(minicity_annotations["train"])
    path = tmp_path / "gsmap_minicity_train.arrow"
    write_annotations(path, source.meta, [replace(source[0], can_bus=np.arange(1.0, 19.0))])
    config = dataset_config(MINICITY, "train_dataloader", minicity_root, ann_file=str(path))
    can_bus = build(**config).get_data_info(0)["can_bus"]
    assert can_bus.tolist() == [0, 0, 0, *range(4, 18), 0]


def test_signals_that_a_drive_does_not_have_come_from_its_poses_if_that_is_asked_for(
    build, minicity_root, minicity_annotations, tmp_path
):
    source = AnnotationFile(minicity_annotations["train"])
    path = tmp_path / "gsmap_minicity_train.arrow"
    write_annotations(path, source.meta, [replace(s, can_bus=None) for s in source])
    config = dataset_config(MINICITY, "train_dataloader", minicity_root, ann_file=str(path))
    assert not build(**config).get_data_info(0)["can_bus"].any()
    dataset = build(**config, signals_from_poses=True)
    for row, sample in enumerate(source):
        found, true = dataset.get_data_info(row)["can_bus"], without_history(sample.can_bus)
        np.testing.assert_allclose(found[3:7], true[3:7], atol=1e-6)  # orientation
        np.testing.assert_allclose(found[7:10], true[7:10], atol=1.5)  # acceleration, m/s2
        np.testing.assert_allclose(found[10:13], true[10:13], atol=0.2)  # turn rate, rad/s
        np.testing.assert_allclose(found[13:16], true[13:16], atol=1.5)  # velocity, m/s
        assert found[16] == pytest.approx(true[16])
        assert found[9] > 9.0  # an accelerometer feels gravity


def test_a_speed_comes_from_the_pose_and_the_time_of_the_sample_beside(
    build, minicity_root, minicity_annotations, tmp_path
):
    """3 m ahead in half a second are 6 m/s; the first sample looks ahead, the second back."""
    source = AnnotationFile(minicity_annotations["train"])
    path, moved = tmp_path / "gsmap_minicity_train.arrow", source[0].global_from_frame.copy()
    ahead = moved[:3, 0 if source.meta.frame == "ego" else 1]
    moved[:3, 3] += 3.0 * ahead
    here = replace(source[0], can_bus=None)
    later = replace(
        here, token="later", timestamp_ns=here.timestamp_ns + 5 * 10**8, global_from_frame=moved
    )
    write_annotations(path, source.meta, [here, later])
    config = dataset_config(MINICITY, "train_dataloader", minicity_root, ann_file=str(path))
    dataset = build(**config, signals_from_poses=True)
    for row in range(2):
        velocity = dataset.get_data_info(row)["can_bus"][13:16]
        np.testing.assert_allclose(velocity, [6, 0, 0], atol=1e-6)
    # Samples of another drive lie between these two.
    others = [replace(sample, scene="other", token=f"{sample.token}-2") for sample in (here, later)]
    write_annotations(path, source.meta, [here, others[1], later, others[0]])
    dataset = build(**config, signals_from_poses=True)
    for row in range(4):
        velocity = dataset.get_data_info(row)["can_bus"][13:16]
        np.testing.assert_allclose(velocity, [6, 0, 0], atol=1e-6)


def test_an_image_size_needs_a_sample_with_one_of_the_cameras(
    build, minicity_root, minicity_annotations, tmp_path
):
    source = AnnotationFile(minicity_annotations["train"])
    without = replace(source[0], cameras=[], token="without")
    path = tmp_path / "gsmap_minicity_train.arrow"
    config = dataset_config(MINICITY, "train_dataloader", minicity_root)
    size = build(**config).scaled_image_size()
    for samples, wanted in (([without, source[0]], size), ([without], None)):
        write_annotations(path, source.meta, samples)
        config = dataset_config(MINICITY, "train_dataloader", minicity_root, ann_file=str(path))
        assert build(**config).scaled_image_size() == wanted


def test_a_file_without_poses_has_none_as_a_source(minicity_annotations, tmp_path):
    source = AnnotationFile(minicity_annotations["train"])
    assert open_annotations(source.path).has_poses
    options = {**source.meta.options, "poses": False}
    write_annotations(tmp_path / "a.arrow", replace(source.meta, options=options), source)
    assert not open_annotations(tmp_path / "a.arrow").has_poses


@pytest.mark.parametrize(
    ("frame", "ground_z_m", "has_mounting", "height_m"),
    [
        ("lidar", None, True, 1.9),  # z = 0 of the vehicle is the road
        ("lidar", -2.5, True, 1.9),
        ("lidar", -2.5, False, 2.5),
        ("lidar", None, False, None),  # not known
        ("ego", None, False, 0.31),  # the axle of Argoverse 2
        ("ego", 0.0, False, 0.0),
        ("ego", -1.6, False, 1.6),
    ],
)
def test_the_height_of_the_frame_above_the_road(
    build, minicity_annotations, tmp_path, frame, ground_z_m, has_mounting, height_m
):
    sample = AnnotationFile(minicity_annotations["train"])[0]
    mounting = np.eye(4)
    mounting[2, 3] = 1.9
    sample = replace(sample, ego_from_frame=mounting if has_mounting else None)
    source = AnnotationFile(minicity_annotations["train"]).meta
    meta = replace(source, frame=frame, ground_z_m=ground_z_m)  # with the range of the config
    write_annotations(tmp_path / "a.arrow", meta, [sample])
    config = dataset_config(MINICITY, "train_dataloader", tmp_path, ann_file="a.arrow")
    lidar2ground = build(**{**config, "frame": frame}).get_data_info(0)["lidar2ground"]
    if height_m is None:
        assert lidar2ground is None
    else:
        assert lidar2ground[2, 3] == pytest.approx(height_m)


def test_signals_of_the_pose_alone_are_those_of_maptr_on_argoverse_2(
    build, minicity_root, minicity_annotations
):
    """Quaternion of the vehicle, ones, and its yaw in [0, 2 pi), whatever the sample has."""
    config = dataset_config(MINICITY, "train_dataloader", minicity_root)
    dataset = build(**config, pose_only_signals=True)
    for row, sample in enumerate(AnnotationFile(minicity_annotations["train"])):
        found = dataset.get_data_info(row)["can_bus"]
        ego = sample.global_from_frame @ np.linalg.inv(sample.ego_from_frame)
        w, x, y, z = found[3:7]
        turned = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]
        np.testing.assert_allclose(turned, ego[:3, 0], atol=1e-6)  # its x axis in the world
        assert np.linalg.norm(found[3:7]) == pytest.approx(1)
        np.testing.assert_array_equal(found[7:16], 1)
        assert found[16] == pytest.approx(np.arctan2(ego[1, 0], ego[0, 0]) % (2 * np.pi))
        np.testing.assert_array_equal(found[[0, 1, 2, 17]], 0)
    assert dataset.has_signals()


def test_signals_are_zero_for_a_model_that_was_trained_without(
    build, minicity_root, minicity_annotations, tmp_path
):
    source = AnnotationFile(minicity_annotations["train"])
    config = dataset_config(MINICITY, "train_dataloader", minicity_root)
    for options in ({}, {"pose_only_signals": True}, {"signals_from_poses": True}):
        dataset = build(**config, **options, zero_signals=True)
        dataset.can_bus_in_memory = np.ones(18)
        assert not dataset.get_data_info(0)["can_bus"].any()
        assert not dataset.has_signals()
    assert source.has_signals()
    path = tmp_path / "gsmap_minicity_train.arrow"
    write_annotations(path, source.meta, [replace(s, can_bus=None) for s in source])
    assert not AnnotationFile(path).has_signals()


def test_one_sample_with_signals_or_poses_that_give_them_count_as_signals(
    build, minicity_root, minicity_annotations, tmp_path
):
    first, *others = AnnotationFile(minicity_annotations["train"])
    meta = AnnotationFile(minicity_annotations["train"]).meta
    path = tmp_path / "gsmap_minicity_train.arrow"
    config = dataset_config(MINICITY, "train_dataloader", minicity_root, ann_file=str(path))
    write_annotations(path, meta, [replace(first, can_bus=None), *others])
    assert build(**config).has_signals()
    without = [replace(sample, can_bus=None) for sample in (first, *others)]
    write_annotations(path, meta, without)
    assert not build(**config).has_signals()
    assert build(**config, signals_from_poses=True).has_signals()
    write_annotations(path, replace(meta, options={**meta.options, "poses": False}), without)
    assert not build(**config, signals_from_poses=True).has_signals()


@pytest.fixture(scope="module")
def with_heights(minicity_annotations, tmp_path_factory) -> Path:
    """MiniCity's training file with points of three coordinates: z = 0.1 x - 1.8."""
    path = tmp_path_factory.mktemp("heights") / "gsmap_minicity_train.arrow"
    return write_raised(minicity_annotations["train"], path)


def test_heights_of_a_file_are_handed_on_beside_points_of_two_coordinates(
    build, minicity_root, with_heights, minicity_annotations
):
    config = dataset_config(MINICITY, "train_dataloader", minicity_root)
    info = build(**{**config, "ann_file": str(with_heights)}).get_data_info(0)
    assert {e.points.shape[1] for e in info["map_instances"]} == {2}
    for element, heights in zip(info["map_instances"], info["map_heights"], strict=True):
        np.testing.assert_allclose(heights, 0.1 * element.points[:, 0] - 1.8, atol=1e-5)
    assert build(**config).get_data_info(0)["map_heights"] is None


def test_another_rule_of_the_crossings_is_refused(build, minicity_root, minicity_annotations):
    config = dataset_config(MINICITY, "train_dataloader", minicity_root)
    assert len(build(**config, crossings="united"))
    with pytest.raises(ValueError, match=r"made with crossings united, .* asks for edges: change"):
        build(**config, crossings="edges")


def test_two_coordinates_of_a_file_of_three_are_those_of_a_file_of_two(
    build, minicity_root, minicity_annotations, with_heights
):
    """Reading heights as further points of the plane would give an mAP of 0."""
    config = dataset_config(DEPTH_AND_MASKS, "train_dataloader", minicity_root)
    flat, high = build(**config), build(**{**config, "ann_file": str(with_heights)})
    for index in range(len(flat)):
        np.random.seed(index)  # noqa: NPY002 - draws the orders of long rings
        wanted = flat[index]["data_samples"]
        np.random.seed(index)  # noqa: NPY002
        found = high[index]["data_samples"]
        for name in wanted.gt_instances_3d.keys():  # noqa: SIM118 - InstanceData is no mapping
            assert torch.equal(found.gt_instances_3d[name], wanted.gt_instances_3d[name])
        assert torch.equal(found.gt_pv_seg, wanted.gt_pv_seg)
        assert torch.equal(found.gt_seg, wanted.gt_seg)
        truth, expected = found.eval_ann_info, wanted.eval_ann_info
        for line, other in zip(truth["polylines"], expected["polylines"], strict=True):
            np.testing.assert_array_equal(line, other)
    assert high.metainfo == flat.metainfo


def test_three_coordinates_reach_targets_and_evaluation(build, minicity_root, with_heights):
    config = dataset_config(MINICITY, "train_dataloader", minicity_root, dim=3)
    dataset = build(**{**config, "ann_file": str(with_heights)})
    sample = dataset[0]["data_samples"]
    targets = sample.gt_instances_3d
    assert targets.pts.shape == (len(targets), 20, 3)
    assert targets.pts_shifts.shape == (len(targets), 19, 20, 3)
    assert targets.boxes.shape == (len(targets), 4)
    torch.testing.assert_close(targets.pts[..., 2], 0.1 * targets.pts[..., 0] - 1.8)
    assert {line.shape[1] for line in sample.eval_ann_info["polylines"]} == {3}
    assert dataset.metainfo["dim"] == 3
    assert build(ann_file=str(with_heights), dim=None).metainfo["dim"] == 3


def test_a_file_of_two_coordinates_is_refused_for_three(build, minicity_annotations):
    message = r"made with dim 2, the config asks for 3: .*create_data.py"
    with pytest.raises(ValueError, match=message):
        build(ann_file=str(minicity_annotations["val"]), dim=3)
    with pytest.raises(ValueError, match="dim must be 2, 3 or None, got 4"):
        build(ann_file=str(minicity_annotations["val"]), dim=4)


def test_a_file_of_another_rate_than_the_config_trains_at_is_refused(
    build, minicity_annotations, tmp_path
):
    """Samples of two drives in turn, of 2 Hz each; one of a drive is missing."""
    source = AnnotationFile(minicity_annotations["train"])
    path = tmp_path / "gsmap_minicity_train.arrow"
    drives = [
        replace(source[0], token=f"{drive}{i}", scene=drive, timestamp_ns=start + i * 500_000_000)
        for i in range(5)
        for drive, start in (("a", 0), ("b", 70_000_000))
        if (drive, i) != ("b", 2)
    ]
    write_annotations(path, source.meta, drives)
    for rate_hz in (None, 2.0, 1.9, 2.2):
        assert len(build(ann_file=str(path), rate_hz=rate_hz)) == 9
    message = r"has 2 samples per second of a drive, the config asks for 10: .*--rate 10hz.*rate_hz"
    with pytest.raises(ValueError, match=message):
        build(ann_file=str(path), rate_hz=10.0)
    with pytest.raises(ValueError, match=r"asks for 2\.5: make it again"):
        build(ann_file=str(path), rate_hz=2.5)
    write_annotations(path, source.meta, drives[:2])
    assert len(build(ann_file=str(path), rate_hz=10.0)) == 2  # no drive says


def test_lidar_points_meet_their_depths_in_the_cameras(build, minicity_root, minicity_annotations):
    config = dataset_config(DEPTH_AND_MASKS, "train_dataloader", minicity_root)
    data = build(**config)[0]["data_samples"]
    depth, lidar2img = data.gt_depth, data.metainfo["lidar2img"][0]
    assert depth.shape == (6, 128, 224)  # 112 x 200, padded to multiples of 32
    row, col = (int(v) for v in torch.nonzero(depth[0])[0])
    frame_from_img = np.linalg.inv(lidar2img)
    d = float(depth[0, row, col])
    point = frame_from_img @ np.array([col * d, row * d, d, 1])
    path = minicity_root / build(**config).sample(0).lidar.path
    points = np.fromfile(path, np.float32).reshape(-1, 5)[:, :3]
    # a pixel is as wide as the point may be off
    pixel_m = d * np.abs(frame_from_img[:3, :2]).sum()
    assert np.linalg.norm(points - point[:3], axis=1).min() < pixel_m
    assert data.gt_seg.shape == (3, 200, 100)  # a channel a class
    assert data.gt_pv_seg.shape == (6, 3, 4, 7)
    assert 0 < data.gt_seg.mean() < 0.5
    assert 0 < data.gt_pv_seg.mean() < 1


def test_sweeps_lie_where_the_key_frame_does(build, minicity_root, minicity_annotations):
    config = dataset_config(SWEEPS, "val_dataloader", minicity_root)
    points = build(**config)[1]["inputs"]["points"]
    now, before = points[points[:, 4] == 0], points[points[:, 4] > 0]
    assert len(before) > 100
    # the ground of both lies at one height, though the vehicle has moved
    near = (now[:, :2].norm(dim=1) < 8).nonzero()[:, 0]
    near_before = (before[:, :2].norm(dim=1) < 8).nonzero()[:, 0]
    assert float(now[near, 2].median()) == pytest.approx(
        float(before[near_before, 2].median()), abs=0.1
    )


def test_shuffled_images_come_from_another_sample_with_this_one_s_calibration(
    build, minicity_root, minicity_annotations
):
    plain = build(ann_file="gsmap_minicity_val.arrow", data_root=str(minicity_root))
    mixed = build(
        ann_file="gsmap_minicity_val.arrow", data_root=str(minicity_root), shuffle_images_seed=3
    )
    own, other = plain.get_data_info(0), mixed.get_data_info(0)
    assert own["token"] == other["token"]
    for name in CAMERAS:
        assert (
            other["images"][name]["img_path"] == plain.get_data_info(1)["images"][name]["img_path"]
        )
        np.testing.assert_array_equal(
            own["images"][name]["lidar2cam"], other["images"][name]["lidar2cam"]
        )


def test_camera_subset_and_indices(build, minicity_root, minicity_annotations):
    dataset = build(
        ann_file="gsmap_minicity_val.arrow",
        data_root=str(minicity_root),
        cameras=["CAM_BACK", "CAM_FRONT"],
        indices=[1],
    )
    assert len(dataset) == 1
    info = dataset.get_data_info(0)
    assert info["cam_names"] == ["CAM_BACK", "CAM_FRONT"]
    assert info["token"] == AnnotationFile(minicity_annotations["val"])[1].token
    assert dataset.metainfo["classes"] == ("divider", "ped_crossing", "boundary")


def test_it_pickles_small_for_workers(build, minicity_root, minicity_annotations):
    dataset = build(**dataset_config(MINICITY, "val_dataloader", minicity_root))
    data = pickle.dumps(dataset)
    assert len(data) < 10_000
    assert pickle.loads(data).sample(1).token == dataset.sample(1).token


def test_it_repeats_and_goes_through_workers(build, minicity_root, minicity_annotations):
    from mmdet3d.registry import DATASETS
    from mmengine.runner import Runner

    loader = Config.fromfile(CONFIGS / f"{MINICITY}.py").train_dataloader
    dataset = dataset_config(MINICITY, "train_dataloader", minicity_root)
    loader.dataset = {"type": "RepeatDataset", "times": 3, "dataset": dataset}
    assert len(DATASETS.build(loader.dataset)) == 6
    batches = list(Runner.build_dataloader(loader, seed=0))
    assert sum(len(batch["data_samples"]) for batch in batches) == 6
    assert batches[0]["inputs"]["img"][0].shape == (6, 3, 90, 160)


def test_data_sets_of_other_cars_are_joined_and_other_classes_are_named(
    build, minicity_root, minicity_annotations, tmp_path
):
    """The images of the other car are 8 pixels wider, and its LiDAR is mounted 0.1 m higher."""
    from mmdet3d.registry import DATASETS

    source = AnnotationFile(minicity_annotations["train"])
    samples = []
    for sample in source:
        cameras = [replace(camera, width=camera.width + 8) for camera in sample.cameras]
        mounting = sample.ego_from_frame.copy()
        mounting[2, 3] += 0.1
        samples.append(replace(sample, cameras=cameras, ego_from_frame=mounting))
    first = {"type": "VectorizedMapDataset", "ann_file": str(minicity_annotations["train"])}
    other = {**first, "ann_file": str(tmp_path / "other.arrow")}
    joined = {"type": "ConcatDataset", "datasets": [first, other]}
    write_annotations(tmp_path / "other.arrow", source.meta, samples)
    assert len(DATASETS.build(joined)) == 2 * len(source)
    meta = replace(source.meta, classes=("boundary", "divider", "ped_crossing"), split="val")
    write_annotations(tmp_path / "other.arrow", meta, samples)
    message = r"data sets 1 and 2 of ConcatDataset differ in 'classes': \('divider', .*'boundary', "
    with pytest.raises(ValueError, match=message):
        DATASETS.build(joined)
    with pytest.raises(ValueError, match=r"'split': 'train' and 'val'.*ignore_keys=\['split'\]"):
        DATASETS.build({**joined, "ignore_keys": "classes"})
    assert len(DATASETS.build({**joined, "ignore_keys": ["classes", "split"]})) == 2 * len(source)
    samples = [replace(sample, cameras=sample.cameras[::-1]) for sample in samples]
    write_annotations(tmp_path / "other.arrow", source.meta, samples)
    with pytest.raises(ValueError, match=r"differ in 'rig': \['CAM_"):
        DATASETS.build(joined)
    selected = [{**part, "cameras": ["CAM_FRONT"]} for part in (first, other)]
    assert len(DATASETS.build({**joined, "datasets": selected})) == 2 * len(source)


def test_wrappers_and_data_sets_with_nested_metainfo_are_joined(build, minicity_annotations):
    from mmdet3d.registry import DATASETS
    from mmengine.dataset import BaseDataset

    path = minicity_annotations["train"]
    plain = {"type": "VectorizedMapDataset", "ann_file": str(path)}
    repeated = {"type": "RepeatDataset", "times": 3, "dataset": plain}
    inner = {"type": "ConcatDataset", "datasets": [repeated, plain]}
    joined = DATASETS.build({"type": "ConcatDataset", "datasets": [inner, plain]})
    assert len(joined) == 5 * len(AnnotationFile(path))
    metainfo = {"palette": [[1], [1, 2]], "mean": np.ones(2)}
    parts = [BaseDataset(metainfo=metainfo, lazy_init=True) for _ in range(2)]
    assert joined.__class__(parts, lazy_init=True).metainfo["palette"] == [[1], [1, 2]]
    parts[1]._metainfo["mean"] = np.zeros(2)
    with pytest.raises(ValueError, match="differ in 'mean'"):
        joined.__class__(parts, lazy_init=True)


def test_joined_tests_with_equal_tokens_are_refused(build, minicity_annotations, tmp_path):
    """The metric would score only the first of two samples of one token."""
    from mmdet3d.registry import DATASETS

    source = AnnotationFile(minicity_annotations["val"])
    samples = list(source)
    other_path = tmp_path / "other.arrow"
    write_annotations(other_path, source.meta, samples)
    first = {
        "type": "VectorizedMapDataset",
        "ann_file": str(minicity_annotations["val"]),
        "test_mode": True,
    }
    other = {**first, "ann_file": str(other_path)}
    repeated = {"type": "RepeatDataset", "times": 2, "dataset": first}
    inner = {"type": "ConcatDataset", "datasets": [repeated]}
    message = rf"{minicity_annotations['val']} and {other_path} both have the sample .*tokens"
    for parts in ([first, other], [repeated, other], [inner, other]):
        joined = {"type": "ConcatDataset", "datasets": parts}
        with pytest.raises(ValueError, match=message):
            DATASETS.build(joined)
        late = DATASETS.build({**joined, "lazy_init": True})
        with pytest.raises(ValueError, match=message):
            late.full_init()
    halves = [{**first, "indices": [0]}, {**other, "indices": [1]}]
    assert len(DATASETS.build({"type": "ConcatDataset", "datasets": halves})) == 2
    assert len(DATASETS.build(inner)) == 2 * len(samples)
    samples = [replace(sample, token=f"b_{sample.token}") for sample in samples]
    write_annotations(other_path, source.meta, samples)
    joined = {"type": "ConcatDataset", "datasets": [repeated, other]}
    assert len(DATASETS.build(joined)) == 3 * len(samples)


def test_it_tests_without_ground_truth_and_refuses_to_train(
    build, minicity_root, minicity_annotations, tmp_path
):
    file = AnnotationFile(minicity_annotations["val"])
    samples = list(file)
    for sample in samples:
        sample.instances = None
    write_annotations(tmp_path / "bare.arrow", file.meta, samples)
    config = dataset_config(MINICITY, "val_dataloader", minicity_root)
    config.ann_file = str(tmp_path / "bare.arrow")
    packed = build(**config)[0]["data_samples"]
    assert packed.metainfo["eval_ann_info"] is None
    with pytest.raises(ValueError, match=r"2 samples .* have no ground truth"):
        build(ann_file=config.ann_file, data_root=str(minicity_root))


def test_samples_without_elements_train_only_if_asked(build, minicity_annotations, tmp_path):
    file = AnnotationFile(minicity_annotations["val"])
    samples = list(file)
    samples[0].instances = []
    write_annotations(tmp_path / "some.arrow", file.meta, samples)
    assert len(build(ann_file=str(tmp_path / "some.arrow"))) == 1
    assert len(build(ann_file=str(tmp_path / "some.arrow"), filter_empty_gt=False)) == 2
    assert len(build(ann_file=str(tmp_path / "some.arrow"), test_mode=True)) == 2


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ({"classes": ["divider"]}, "classes .*config asks for"),
        ({"grid": {"x_range": [-30, 30], "y_range": [-15, 15]}}, "x_range .*config asks for"),
        ({"split": "train"}, "split val, the config asks for train"),
        ({"frame": "ego"}, "frame lidar, the config asks for ego"),
        ({"broken_samples": "ignore"}, "broken_samples"),
        ({"indices": 0}, "at least one sample"),
        ({"broken_samples": "skip", "test_mode": True}, "a test must see every sample"),
        ({"grid": {"x_range": [2, 1], "y_range": [0, 1]}}, "x_range"),
    ],
)
def test_what_does_not_fit_is_refused(build, minicity_annotations, option, message):
    with pytest.raises(ValueError, match=message):
        build(ann_file=str(minicity_annotations["val"]), **option)


def test_it_keeps_the_contract_of_a_base_dataset(build, minicity_root, minicity_annotations):
    """Opened late, cut to subsets by number, from the end or by list, and told its labels."""
    config = {"ann_file": "gsmap_minicity_val.arrow", "data_root": str(minicity_root)}
    whole = AnnotationFile(minicity_annotations["val"])
    for serialize_data in (True, False):
        dataset = build(**config, lazy_init=True, serialize_data=serialize_data)
        assert dataset.metainfo == {}
        dataset.full_init()
        assert dataset.metainfo["split"] == "val"
        for indices, row in ((1, 0), (-1, 1), ([1], 1)):
            subset = dataset.get_subset(indices)
            assert (len(subset), len(dataset)) == (1, 2)
            assert subset.get_data_info(0)["token"] == whole[row].token
        assert dataset.get_cat_ids(1) == [i.label for i in whole[1].instances]
        dataset.get_subset_([1])
        assert dataset.sample(0).token == whole[1].token
