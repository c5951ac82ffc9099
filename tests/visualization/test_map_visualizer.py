import logging
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from mmdet3d.registry import HOOKS, VISUALIZERS
from mmdet3d.structures import Det3DDataSample
from mmengine.config import Config
from mmengine.structures import InstanceData

import gsmap.visualization.map_visualization_hook  # noqa: F401 (registers the hook)
from gsmap.evaluation.core.chamfer_ap import ChamferConfig, match_chamfer
from gsmap.structures.frames import FRAME_VIEWS
from gsmap.visualization.figure import sample_name, sample_title
from gsmap.visualization.map_visualizer import (
    ground_truth_elements,
    images_from_inputs,
    predicted_elements,
)

RUNTIME = Path(__file__).resolve().parents[2] / "configs/_base_/default_runtime.py"
CLASSES = ("divider", "ped_crossing", "boundary")


def make_sample(folder, gaussians=True, truth=True, cameras=2, token="scene/1"):
    paths = []
    for i in range(cameras):
        path = folder / f"camera{i}.jpg"
        cv2.imwrite(str(path), np.full((90, 160, 3), 80, np.uint8))
        paths.append(str(path))
    projection = np.array([[80.0, 80, 0, 0], [0, 45, -80, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    half = np.diag([0.5, 0.5, 1, 1])
    info = {"polylines": [np.array([[0.0, 1], [0, 20]])], "labels": np.array([0])}
    sample = Det3DDataSample(
        metainfo={
            "token": token,
            "scene": "scene",
            "img_path": paths,
            "cam_names": [f"CAM_{i}" for i in range(cameras)],
            "lidar2img": np.reshape([half @ projection] * cameras, (-1, 4, 4)),
            "img_aug_matrix": np.reshape([half] * cameras, (-1, 4, 4)),
            "eval_ann_info": info if truth else None,
        }
    )
    fields = {
        "scores_3d": torch.tensor([0.9, 0.2, 0.6]),
        "labels_3d": torch.tensor([0, 1, 2]),
        "pts": torch.arange(3 * 4 * 2, dtype=torch.float32).reshape(3, 4, 2) / 2,
    }
    if gaussians:
        fields |= {"scales": torch.full((3, 4, 2), 0.5), "rotations": torch.zeros(3, 4)}
    sample.pred_instances_3d = InstanceData(**fields)
    return sample


def make_visualizer(name, **options):
    visualizer = VISUALIZERS.build({"type": "MapVisualizer", "name": name, **options})
    visualizer.dataset_meta = {"classes": CLASSES, "frame": "lidar"}
    return visualizer


def titles(figure):
    return [ax.get_title() for ax in figure.axes if ax.get_title()]


def test_panels_follow_what_the_sample_has(tmp_path):
    visualizer = make_visualizer("panels", width_px=300)

    def drawn(score_thr=None, predicted=True, **parts):
        sample = make_sample(tmp_path, cameras=0, **parts)
        if not predicted:
            del sample.pred_instances_3d
        figure = visualizer.draw_sample(sample, score_thr=score_thr)
        return titles(figure), {text.get_text() for ax in figure.axes for text in ax.texts}

    full = [
        "Ground truth",
        "Prediction",
        "Hits within 1 m",
        "Gaussians (1\N{GREEK SMALL LETTER SIGMA})",
    ]
    assert drawn()[0] == full
    assert drawn(gaussians=False)[0] == full[:3]
    assert drawn(truth=False)[0] == full[1::2]
    panels, notes = drawn(truth=False, score_thr=0.99)
    assert panels == full[1::2]
    assert "no score reaches 0.99\n(highest 0.9)" in notes
    assert drawn(predicted=False)[0] == full[:1]
    visualizer.panels = ("rasters",)
    assert drawn()[0] == ["Rendered masks"]


def test_a_note_stays_in_its_panel(tmp_path):
    visualizer = make_visualizer("note")
    figure = visualizer.draw_sample(make_sample(tmp_path, cameras=0), score_thr=0.999)
    panels = [ax for ax in figure.axes for text in ax.texts if "no score" in text.get_text()]
    assert len(panels) == 3  # beside the ground truth
    for ax in panels:
        box, note = ax.get_window_extent(), ax.texts[-1].get_window_extent()
        assert box.x0 < note.x0 < note.x1 < box.x1
        assert box.y0 < note.y0 < note.y1 < box.y1


def labels(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_hits_are_those_of_the_evaluation_and_the_legend_has_what_is_drawn(tmp_path):
    """Dividers 0.4 m, 0.6 m and 6 m beside the only one; the crossing has no counterpart."""
    sample = make_sample(tmp_path, cameras=0)
    ahead = np.linspace(1, 20, 20)
    lines = [np.c_[np.full(20, x), ahead] for x in (0.6, 0.4, 6.0, -8.0)]
    scores = np.array([0.6, 0.9, 0.8, 0.7])
    sample.pred_instances_3d = InstanceData(
        scores_3d=torch.tensor(scores),
        labels_3d=torch.tensor([0, 0, 0, 1]),
        pts=torch.tensor(np.stack(lines)),
    )
    visualizer = make_visualizer("matches", panels=["matches"], width_px=300)
    truth, found = ground_truth_elements(sample), predicted_elements(sample)
    matched = match_chamfer(found, truth, ChamferConfig(CLASSES))
    hits = set(matched.pred_index[matched.matched_gt[:, 1] >= 0])
    (panel,) = visualizer._bev_panels(truth, found, None, "")
    assert panel.outcomes == (["hit" if i in hits else "false" for i in range(4)], ["found"])
    assert found.confidence[list(hits)] == [0.9]
    figure = visualizer.draw_sample(sample)
    assert labels(figure) == [
        "divider",
        "pedestrian crossing",
        "hit (1)",
        "false (3)",
        "truth found (1)",
    ]
    assert labels(visualizer.draw_sample(sample, score_thr=0.95)) == ["truth missed (1)"]
    visualizer.match_m = 0.2
    strict = labels(visualizer.draw_sample(sample, score_thr=0.85))
    assert strict == ["divider", "false (1)", "truth missed (1)"]


def test_scene_and_time_name_a_picture(tmp_path):
    meta = {"scene": "scene/7", "seconds": 12.5, "token": "0123456789abcdef"}
    assert sample_name(meta | {"scene": "a"}, ".png") == "a_0012.50s_89abcdef.png"
    assert sample_name(meta, ".png") == "scene_7_0012.50s_89abcdef-8f86fd439eaf1e35.png"
    names = {sample_name(meta | {"token": f"{c}-SAMETAIL"}, ".png") for c in "abc"}
    assert len(names) == 3
    assert sample_title(meta) == "scene/7  ·  12.50 s  ·  0123456789abcdef"
    assert sample_name({"scene": "a", "token": "b/1"}, ".png") == "b_1-c2c4324fdbeececd.png"
    sample = make_sample(tmp_path, cameras=0)
    sample.set_metainfo({"seconds": 3.0})
    figure = make_visualizer("named", width_px=300).draw_sample(sample)
    assert figure.texts[0].get_text() == "scene  ·  3.00 s  ·  scene/1"


def test_predictions_are_chosen_by_score_and_drawn_in_its_order(tmp_path):
    sample = make_sample(tmp_path)
    found = predicted_elements(sample)
    assert found.labels.tolist() == [1, 2, 0]
    np.testing.assert_allclose(found.polylines[2], sample.pred_instances_3d.pts[0])
    np.testing.assert_allclose(found.scales[4:8], sample.pred_instances_3d.scales[2])
    figure = make_visualizer("chosen", panels=["prediction"]).draw_sample(sample, score_thr=0.5)
    assert labels(figure) == ["divider", "road boundary"]


def test_ground_truth_falls_back_to_the_training_targets(tmp_path):
    sample = make_sample(tmp_path, truth=False)
    assert ground_truth_elements(sample) is None
    sample.gt_instances_3d = InstanceData(pts=torch.ones(2, 20, 2), labels_3d=torch.tensor([2, 0]))
    assert ground_truth_elements(sample).labels.tolist() == [2, 0]


def test_projections_lose_the_augmentation_for_original_files_only(tmp_path):
    visualizer = make_visualizer("projections")
    meta = make_sample(tmp_path).metainfo
    original = visualizer.cameras(meta)[0]
    assert original.image.shape == (90, 160, 3)
    np.testing.assert_allclose(original.img_from_frame[0], [80, 80, 0, 0])
    seen = visualizer.cameras(meta, [np.zeros((45, 80, 3), np.uint8)] * 2)[0]
    np.testing.assert_allclose(seen.img_from_frame[0], [40, 40, 0, 0])
    with pytest.raises(ValueError, match="1 images, but 2 projections"):
        visualizer.cameras(meta, [np.zeros((45, 80, 3), np.uint8)])


def test_ground_follows_the_mounting_or_the_option():
    mounting = np.eye(4)
    mounting[2, 3] = 2.5
    assert make_visualizer("mounted").frame_view({"lidar2ego": mounting}).ground == (0, 0, -2.5)
    assert make_visualizer("usual").frame_view({}).ground == (0, 0, -1.84)
    fixed = make_visualizer("fixed", ground_z_m=-1.0)
    assert fixed.frame_view({"lidar2ego": mounting}).ground == (0, 0, -1.0)


def test_extent_and_frame_come_from_the_data_set():
    visualizer = make_visualizer("extent")
    visualizer.dataset_meta = None
    assert visualizer.frame_view({}) is FRAME_VIEWS["lidar"]
    visualizer.dataset_meta = {"x_range": (-30, 30), "y_range": (-15, 15), "frame": "ego"}
    assert visualizer.grid.x_range == (-30, 30)
    assert visualizer.frame_view({}) is FRAME_VIEWS["ego"]
    visualizer.dataset_meta = {"frame": "map"}
    with pytest.raises(ValueError, match="No view is known for frame 'map'"):
        visualizer.frame_view({})


def test_pictures_reach_tensorboard(tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    visualizer = make_visualizer(
        "board",
        width_px=300,
        vis_backends=[{"type": "TensorboardVisBackend"}],
        save_dir=str(tmp_path),
    )
    hook = HOOKS.build(Config.fromfile(RUNTIME).default_hooks.visualization)
    for runner in (FakeRunner(visualizer, batches=3), FakeRunner(visualizer, batches=3, step=9)):
        hook.after_val_iter(runner, 0, {}, [make_sample(tmp_path, token="1")])
    visualizer.close()
    events = EventAccumulator(str(tmp_path / "vis_data")).Reload()
    images = events.Images("val_1")
    assert [(image.step, image.width) for image in images] == [(3, 300), (9, 300)]
    picture = cv2.imdecode(np.frombuffer(images[0].encoded_image_string, np.uint8), 1)
    assert picture.std() > 20


class FakeRunner:
    """What the hook reads off a runner."""

    def __init__(self, visualizer, batches=10, rank=0, step=3):
        self.visualizer, self.rank, self.iter = visualizer, rank, step
        self.val_dataloader = range(batches)


def test_test_pictures_go_to_the_folder_named_by_token(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    out = tmp_path / "out"
    hook = HOOKS.build(
        {
            "type": "MapVisualizationHook",
            "draw": True,
            "interval": 2,
            "test_out_dir": str(out),
        }
    )
    runner = FakeRunner(make_visualizer("test-hook", width_px=300))
    samples = [make_sample(tmp_path, cameras=1, token=f"a_{i}") for i in range(6)]
    hook.before_test_epoch(runner)
    for start in (0, 4):
        hook.after_test_iter(runner, 0, {}, samples[start : start + 4])
    assert sorted(p.name for p in out.iterdir()) == ["a_0.jpg", "a_2.jpg", "a_4.jpg"]
    runner.logger = logging.getLogger("test-hook")
    hook.after_test_epoch(runner)
    assert f"3 pictures of predictions are in {out}." in caplog.text


def test_validation_draws_the_same_few_samples_on_rank_0(tmp_path, monkeypatch):
    visualizer = make_visualizer("val-hook")
    drawn = []
    monkeypatch.setattr(
        visualizer, "add_datasample", lambda name, *args, **kw: drawn.append((name, kw["step"]))
    )
    hook = HOOKS.build({"type": "MapVisualizationHook", "draw": True, "num_val_samples": 3})
    sample = make_sample(tmp_path)
    for index in range(10):
        sample.set_metainfo({"token": str(index)})
        hook.after_val_iter(FakeRunner(visualizer), index, {}, [sample])
        hook.after_val_iter(FakeRunner(visualizer, rank=1), index, {}, [sample])
    assert drawn == [("val_0", 3), ("val_3", 3), ("val_6", 3)]


def test_hook_is_silent_unless_told_to_draw(tmp_path):
    hook = HOOKS.build({"type": "MapVisualizationHook", "test_out_dir": str(tmp_path / "out")})
    hook.after_test_iter(FakeRunner(None), 0, {}, [make_sample(tmp_path)])
    assert not (tmp_path / "out").exists()


def test_bad_arguments(tmp_path):
    with pytest.raises(ValueError, match="panels must be among"):
        make_visualizer("bad-1", panels=["lidar"])
    with pytest.raises(ValueError, match="interval must be >= 1"):
        HOOKS.build({"type": "MapVisualizationHook", "interval": 0})
    hook = HOOKS.build({"type": "MapVisualizationHook", "draw": True, "test_out_dir": "x"})
    with pytest.raises(TypeError, match="needs visualizer=dict"):
        hook.after_test_iter(FakeRunner(None), 0, {}, [make_sample(tmp_path)])


def test_missing_and_truncated_images_are_named(tmp_path):
    visualizer = make_visualizer("broken")
    meta = make_sample(tmp_path).metainfo
    second = tmp_path / "camera1.jpg"
    second.write_bytes(second.read_bytes()[:-20])
    with pytest.raises(ValueError, match=r"'scene/1': .*camera1.jpg is truncated"):
        visualizer.cameras(meta)
    second.unlink()
    with pytest.raises(ValueError, match=r"'scene/1': no image at .*camera1.jpg"):
        visualizer.cameras(meta)


def test_colours_of_files_are_kept(tmp_path):
    sample = make_sample(tmp_path, cameras=1)
    red = np.zeros((90, 160, 3), np.uint8)
    red[..., 2] = 200  # BGR
    cv2.imwrite(sample.metainfo["img_path"][0], red)
    (view,) = make_visualizer("colours").cameras(sample.metainfo)
    assert np.abs(view.image.mean((0, 1)) - [200, 0, 0]).max() < 5  # JPEG is lossy


def test_inputs_turn_back_into_pictures():
    bgr = torch.zeros(2, 3, 4, 5)
    bgr[1, 0], bgr[1, 2, 0, 0] = 200.4, 300.0
    pictures = images_from_inputs(bgr)
    assert pictures[1].shape == (4, 5, 3)
    assert pictures[1][0, 0].tolist() == [255, 0, 200]
    with pytest.raises(ValueError, match=r"shape \(V, 3, H, W\)"):
        images_from_inputs(bgr[0])


def test_the_road_lies_where_the_annotation_file_says():
    visualizer = make_visualizer("own height")
    visualizer.dataset_meta = {"frame": "ego", "ground_z_m": 0.0}
    assert visualizer.frame_view({}).ground == (0, 0, 0)
    assert visualizer.frame_view({"lidar2ego": np.eye(4)}).ground == (0, 0, 0)
    visualizer.dataset_meta = {"frame": "ego"}
    assert visualizer.frame_view({"lidar2ego": np.eye(4)}).ground == (0, 0, -0.31)
