"""A small MapTR with random weights on generated samples."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from inferencer_cases import NAMES, drive, make_config, make_remembering, make_samples

from gsmap.apis.loading import load_model
from gsmap.apis.map_inferencer import MapInferencer
from gsmap.datasets.annotations.file import write_annotations
from gsmap.datasets.annotations.record import AnnotationMeta
from gsmap.datasets.source import Source, change_frame
from gsmap.visualization.figure import figure_to_rgb


def test_annotation_file_and_samples_give_the_same(inferencer, tmp_path):
    samples = make_samples(tmp_path)
    from_samples = inferencer(samples, tmp_path)
    path = tmp_path / "own.arrow"
    meta = AnnotationMeta("own", "lidar", "anything")
    write_annotations(path, meta, samples)
    dataset = inferencer.dataset(path, tmp_path)
    from_file = list(inferencer.predict(dataset, batch_size=3))
    assert [s.metainfo["token"] for s in from_file] == ["t0", "t1", "t2"]
    for a, b in zip(from_samples, from_file, strict=True):
        # float32 sums in another order: a batch of 3 instead of 1
        torch.testing.assert_close(
            a.pred_instances_3d.pts, b.pred_instances_3d.pts, atol=1e-3, rtol=0
        )
    pts = [s.pred_instances_3d.pts for s in from_file]
    assert (pts[0] - pts[1]).abs().max() > 1e-3  # the images matter


def test_a_files_own_folder_is_where_its_images_are_looked_for(inferencer, tmp_path):
    """By default; the config's root serves a file that lies apart from its images."""
    images = tmp_path / "images"
    images.mkdir()
    samples = make_samples(images, 1)
    for folder in (images, tmp_path):
        write_annotations(folder / "own.arrow", AnnotationMeta("own", "lidar", "any"), samples)
    beside = inferencer.dataset(images / "own.arrow")
    assert [s.metainfo["token"] for s in inferencer.predict(beside)] == ["t0"]
    assert inferencer.dataset(tmp_path / "own.arrow").data_root == ""  # the config's
    assert inferencer.dataset(images / "own.arrow", tmp_path).data_root == str(tmp_path)


def test_chosen_samples_come_in_their_order(inferencer, tmp_path):
    dataset = inferencer.dataset(make_samples(tmp_path), tmp_path)
    assert [s.metainfo["token"] for s in inferencer.predict(dataset, [2, 0])] == ["t2", "t0"]


def test_predictions_are_vectors_and_drawn(inferencer, tmp_path):
    found = inferencer(make_samples(tmp_path, 1), tmp_path)
    assert len(inferencer.vectors(found[0])[0]["pts"]) == 20
    assert figure_to_rgb(inferencer.draw(found[0], score_thr=0.0)).shape[1] == 400


def test_checkpoint_is_loaded(inferencer, tmp_path):
    path = tmp_path / "weights.pth"
    state = {k: torch.full_like(v, 0.01) for k, v in inferencer.model.state_dict().items()}
    torch.save({"state_dict": state}, path)
    loaded = MapInferencer(make_config(), path, device="cpu")
    assert all(
        (value == 0.01).all()
        for key, value in loaded.model.state_dict().items()
        if value.is_floating_point()
    )
    other = make_config()
    other.merge_from_dict({"model.map_head.query_groups": [{"num": 7}]})
    with pytest.raises(
        ValueError, match=r"weights.pth does not belong to this config: .*instance_embedding"
    ):
        MapInferencer(other, path, device="cpu")


def test_images_are_scaled_to_the_size_of_the_training_unless_a_scale_is_given(
    inferencer, tmp_path
):
    path, meta = tmp_path / "weights.pth", {"image_size": (80, 45)}
    torch.save({"state_dict": inferencer.model.state_dict(), "meta": meta}, path)
    samples = make_samples(tmp_path, 1)  # of 320 x 180 pixels; the config has the scale 0.5
    for options, shape in ((None, (45, 80)), ({"image_scale": 0.5}, (90, 160))):
        own = MapInferencer(make_config(), path, device="cpu", cfg_options=options)
        (found,) = own(samples, tmp_path)
        assert found.metainfo["img_shape"][:2] == shape


def test_lidar_points_are_in_the_annotation_frame(inferencer, tmp_path):
    dataset = inferencer.dataset(make_samples(tmp_path, 1), tmp_path)
    np.testing.assert_allclose(
        inferencer.lidar_points(dataset, 0), [[11, 2, -1.8], [13, 4, -1.8]], rtol=1e-6
    )
    (tmp_path / "sweep.bin").write_bytes(b"\x00" * 12)
    with pytest.raises(ValueError, match="not a multiple of 5 float32 values"):
        inferencer.lidar_points(dataset, 0)
    (tmp_path / "sweep.bin").unlink()
    with pytest.raises(FileNotFoundError, match=r"no LiDAR sweep .*sweep.bin"):
        inferencer.lidar_points(dataset, 0)


def test_absent_camera_is_an_error_or_sees_nothing(inferencer, tmp_path):
    samples = make_samples(tmp_path, 2)
    samples[0].cameras = samples[0].cameras[1:]
    dataset = inferencer.dataset(samples, tmp_path)
    with pytest.raises(
        ValueError, match=r"'t0' lacks the cameras \['CAM_FRONT'\].*--allow-missing"
    ):
        list(inferencer.predict(dataset))
    found, _ = inferencer.predict(dataset, allow_missing_cameras=True)
    assert found.metainfo["cam_names"] == list(NAMES)
    assert found.metainfo["img_path"][0] is None
    assert found.metainfo["lidar2img"].shape == (2, 4, 4)
    corners = np.array([[x, y, -1.8, 1.0] for x in (-15, 15) for y in (-30, 30)])
    assert (
        (found.metainfo["lidar2img"][0] @ corners.T)[2] < 0
    ).all()  # all behind the blank camera
    assert len(inferencer.visualizer.cameras(found.metainfo)) == 1


def test_cameras_that_no_sample_has_cost_nothing(inferencer, tmp_path):
    """A single camera is one image, not one and blank ones; what is found is the same."""
    samples = make_samples(tmp_path, 2)
    samples[0].cameras = samples[0].cameras[1:]
    blank, _ = inferencer.predict(inferencer.dataset(samples, tmp_path), None, 1, 0, True)
    (single,) = inferencer.predict(inferencer.dataset(samples[:1], tmp_path), None, 1, 0, True)
    assert single.metainfo["cam_names"] == ["CAM_BACK"]
    assert len(single.metainfo["lidar2img"]) == 1
    for name in ("pts", "scores_3d"):  # float32 sums over one and over two cameras
        found, expected = single.pred_instances_3d[name], blank.pred_instances_3d[name]
        torch.testing.assert_close(found, expected, atol=1e-3, rtol=0)
    assert len(inferencer(make_samples(tmp_path, 1), tmp_path)[0].metainfo["lidar2img"]) == 2


def test_truncated_and_missing_images_are_named(inferencer, tmp_path):
    samples = make_samples(tmp_path, 1)
    dataset = inferencer.dataset(samples, tmp_path)
    image = tmp_path / samples[0].cameras[0].path
    image.write_bytes(image.read_bytes()[:500])
    with pytest.raises(
        ValueError, match=r"'t0', camera CAM_FRONT: .*t0_CAM_FRONT.jpg is truncated"
    ):
        list(inferencer.predict(dataset))
    image.unlink()
    with pytest.raises(ValueError, match=r"'t0', camera CAM_FRONT: no image at"):
        list(inferencer.predict(dataset))


def test_file_of_another_range_is_refused(inferencer, tmp_path):
    cfg = make_config()
    cfg.test_dataloader.dataset.grid = {"x_range": [-30.0, 30.0], "y_range": [-15.0, 15.0]}
    other = MapInferencer(cfg, None, device="cpu")
    write_annotations(
        tmp_path / "a.arrow", AnnotationMeta("x", "lidar", "val"), make_samples(tmp_path, 1)
    )
    with pytest.raises(ValueError, match=r"a.arrow was made with x_range"):
        other.dataset(tmp_path / "a.arrow", tmp_path)


def test_a_model_of_other_classes_than_the_data_set_is_refused(tmp_path):
    cfg = make_config()
    cfg.test_dataloader.dataset.classes = list(cfg.model.classes)[::-1]
    other = MapInferencer(cfg, None, device="cpu")
    with pytest.raises(
        ValueError, match=r"model\.classes is .*, but test_dataloader\.dataset\.clas"
    ):
        other.dataset(make_samples(tmp_path, 1), tmp_path)


def test_a_model_of_another_range_than_the_data_set_predicts(tmp_path):
    """The checkpoint of a model may have set its range."""
    cfg = make_config()
    cfg.test_dataloader.dataset.grid = {"x_range": [-5.0, 5.0], "y_range": [-9.0, 9.0]}
    other = MapInferencer(cfg, None, device="cpu")
    assert len(other.dataset(make_samples(tmp_path, 1), tmp_path)) == 1


def test_missing_config_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no config .*gone.py"):
        MapInferencer(tmp_path / "gone.py", None)


def test_broken_frames_are_set_apart_and_the_others_go_on(inferencer, tmp_path):
    samples = make_samples(tmp_path, 4)
    (tmp_path / samples[1].cameras[0].path).write_bytes(b"no image")
    samples[2].cameras = samples[2].cameras[:1]
    broken = []
    dataset = inferencer.dataset(samples, tmp_path)
    found = inferencer.predict(dataset, batch_size=2, on_broken=broken.append)
    assert [s.metainfo["token"] for s in found] == ["t0", "t3"]
    assert [frame.token for frame in broken] == ["t1", "t2"]
    assert "t1_CAM_FRONT.jpg is not an image" in broken[0].reason
    assert "lacks the cameras ['CAM_BACK']" in broken[1].reason


def test_several_devices_and_mixed_precision_keep_order_and_values(inferencer, tmp_path):
    samples = make_samples(tmp_path)
    torch.manual_seed(0)
    pair = MapInferencer(make_config(), None, device=["cpu", "cpu"])
    pair.replicas[1].load_state_dict(inferencer.model.state_dict())
    pair.replicas[0].load_state_dict(inferencer.model.state_dict())
    alone, together = inferencer(samples, tmp_path), pair(samples, tmp_path)
    assert [s.metainfo["token"] for s in together] == ["t0", "t1", "t2"]
    for a, b in zip(alone, together, strict=True):
        torch.testing.assert_close(a.pred_instances_3d.pts, b.pred_instances_3d.pts)
    pair.amp = True
    for a, b in zip(alone, pair(samples, tmp_path), strict=True):
        shift = (a.pred_instances_3d.pts - b.pred_instances_3d.pts).abs()
        assert 0 < shift.max() < 1.0  # bfloat16 has 8 bits


def test_cameras_of_other_names_and_number_take_the_embeddings_of_their_direction(
    inferencer, tmp_path
):
    """Own names alone change nothing; a camera twice is as itself; one camera does as well."""
    samples = make_samples(tmp_path, 1)
    (usual,) = inferencer(samples, tmp_path)
    front, back = samples[0].cameras
    samples[0].cameras = [replace(back, name="rear"), replace(front, name="windscreen")]
    (renamed,) = inferencer(samples, tmp_path)
    assert renamed.metainfo["cam_names"] == ["rear", "windscreen"]
    torch.testing.assert_close(
        renamed.pred_instances_3d.pts, usual.pred_instances_3d.pts, atol=1e-4, rtol=0
    )
    samples[0].cameras.append(replace(front, name="windscreen2"))
    (thrice,) = inferencer(samples, tmp_path)
    torch.testing.assert_close(
        thrice.pred_instances_3d.pts, usual.pred_instances_3d.pts, atol=1e-3, rtol=0
    )
    samples[0].cameras = samples[0].cameras[:1]
    (alone,) = inferencer(samples, tmp_path)
    assert alone.metainfo["lidar2img"].shape == (1, 4, 4)
    samples[0].cameras = [front, back]
    (again,) = inferencer(samples, tmp_path)
    torch.testing.assert_close(again.pred_instances_3d.pts, usual.pred_instances_3d.pts)


def test_rigs_may_take_turns_and_leave_the_model_as_it_is(inferencer, tmp_path):
    rigs = [make_samples(tmp_path, 3), make_samples(tmp_path, 3)]
    for sample in rigs[1]:
        front, back = sample.cameras
        sample.cameras = [replace(back, name="rear"), replace(front, name="windscreen")]
    datasets = [inferencer.dataset(samples, tmp_path) for samples in rigs]
    weights = {name: value.clone() for name, value in inferencer.model.state_dict().items()}
    alone = [list(inferencer.predict(dataset)) for dataset in datasets]
    versions = []
    embeds = inferencer.model.bev_encoder.cams_embeds
    hook = inferencer.model.bev_encoder.register_forward_pre_hook(
        lambda module, _: versions.append((id(module.cams_embeds), module.cams_embeds._version))
    )
    together = zip(*map(inferencer.predict, datasets), strict=True)
    for turn, samples in enumerate(together):
        for rig, sample in enumerate(samples):
            expected = alone[rig][turn].pred_instances_3d
            assert torch.equal(sample.pred_instances_3d.pts, expected.pts)
    hook.remove()
    assert len(set(versions)) == 2  # recorded frames of each rig can be replayed
    assert inferencer.model.bev_encoder.cams_embeds is embeds
    for name, value in inferencer.model.state_dict().items():
        assert torch.equal(value, weights[name])


def test_embeddings_of_a_rig_follow_a_training_and_a_copy_predicts_as_well(inferencer, tmp_path):
    model = copy.deepcopy(inferencer)  # also its locks
    samples = make_samples(tmp_path, 1)
    front, back = samples[0].cameras
    samples[0].cameras = [replace(back, name="rear"), replace(front, name="windscreen")]
    (before,) = model(samples, tmp_path)
    embeds = model.model.bev_encoder.cams_embeds
    embeds.grad = torch.rand_like(embeds)
    model.model.train()
    torch.optim.AdamW([embeds], lr=1.0, fused=True).step()  # leaves its version as it is
    model.model.eval()
    (after,) = model(samples, tmp_path)
    assert not torch.equal(before.pred_instances_3d.pts, after.pred_instances_3d.pts)
    (kept,) = inferencer(samples, tmp_path)
    assert torch.equal(before.pred_instances_3d.pts, kept.pred_instances_3d.pts)


def test_samples_of_another_frame_are_seen_from_the_model_s(inferencer, tmp_path):
    samples = [change_frame(s, "lidar", "ego") for s in make_samples(tmp_path, 1)]
    (found,) = inferencer(Source(samples, "ego", tmp_path))
    (expected,) = inferencer([change_frame(s, "ego", "lidar") for s in samples], tmp_path)
    torch.testing.assert_close(found.pred_instances_3d.pts, expected.pred_instances_3d.pts)


def test_load_model_gives_the_model_alone(tmp_path):
    model = load_model(make_config(), cfg_options={"model.map_head.coder.max_num": 5})
    assert not model.training
    assert model.cfg.model.map_head.coder.max_num == 5
    state = {k: torch.full_like(v, 0.01) for k, v in model.state_dict().items()}
    torch.save({"state_dict": state}, tmp_path / "weights.pth")
    loaded = load_model(make_config(), tmp_path / "weights.pth").state_dict()
    assert all((v == 0.01).all() for v in loaded.values() if v.is_floating_point())


def test_a_stream_of_ones_own_gives_what_the_whole_drive_gives(inferencer, tmp_path):
    remembering = make_remembering()
    samples = drive(tmp_path)
    whole = remembering(samples, tmp_path)
    stream = remembering.new_stream()
    single = [remembering([sample], tmp_path, stream=stream)[0] for sample in samples]
    for one, other in zip(whole, single, strict=True):
        torch.testing.assert_close(one.pred_instances_3d.pts, other.pred_instances_3d.pts)
    alone = remembering(samples[3:], tmp_path)[0]
    assert not torch.allclose(alone.pred_instances_3d.pts, whole[3].pred_instances_3d.pts)
    with pytest.raises(ValueError, match=r"'scene1' .* comes too late: its stream is at 'scene3'"):
        remembering(samples[1:2], tmp_path, stream=stream)
    with pytest.raises(ValueError, match=r"'other0' .* belongs to another scene than 'scene3'"):
        remembering(drive(tmp_path, 1, "other"), tmp_path, stream=stream)
    with pytest.raises(ValueError, match="the model has no memory"):
        inferencer.new_stream()
    stream, dataset = remembering.new_stream(), remembering.dataset(samples, tmp_path)
    for number, _ in enumerate(remembering.predict(dataset, stream=stream)):
        assert stream.last.token == f"scene{number}"  # no sample before it is asked for
