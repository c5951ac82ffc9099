"""VectorMapNet's head: losses, predictions, other detectors, what is refused."""

from types import SimpleNamespace

import pytest
import torch
from head_cases import HEAD as MAPTR
from methods.vectormapnet.cases import (
    CLASSES,
    DETECTOR,
    GENERATOR,
    GRID,
    bev,
    head,
    sample,
    transformed,
)
from mmdet3d.registry import MODELS
from mmdet3d.structures import Det3DDataSample
from mmengine.config import Config
from mmengine.registry import init_default_scope
from mmengine.structures import InstanceData

from gsmap.apis.export import ExportedDetector
from gsmap.datasets.annotations.record import MapInstance
from gsmap.datasets.elements import elements_of_predictions
from gsmap.datasets.transforms.map_targets import FormatMapTargets, map_targets
from gsmap.engine.launch import check_config, read_config
from gsmap.models.streams.memory import StreamMemory
from gsmap.models.vectormapnet.detector import KeyPointHead, KeyPointPredictions
from gsmap.models.vectormapnet.encoder import HeightPlanesEncoder

CONFIG = "configs/vectormapnet/vectormapnet_r18_minicity.py"
LINES = ([[-20.0, 3.0], [20.0, 3.0]], [[5.0, -10.0], [8.0, -10.0], [8.0, 10.0]])


@pytest.mark.parametrize("number", [0, 1, 2])
def test_every_weight_learns_from_any_number_of_lines(number):
    built = head()
    found = built.loss(bev(), [sample(*LINES[:number])])
    assert set(found) == {"loss_cls", "loss_box", "loss_seq"}
    assert all(torch.isfinite(value) for value in found.values())
    assert (found["loss_seq"] > 0) == (found["loss_box"] > 0) == bool(number)
    sum(found.values()).backward()
    assert all(p.grad is not None for p in built.parameters())


def test_the_loss_falls():
    built = head().train()
    optimizer = torch.optim.AdamW(built.parameters(), 1e-2)
    totals = []
    for _ in range(60):
        losses = built.loss(bev(2), [sample(*LINES), sample(LINES[0])])
        optimizer.zero_grad()
        sum(losses.values()).backward()
        optimizer.step()
        totals.append({name: float(value) for name, value in losses.items()})
    assert all(totals[-1][name] < 0.8 * totals[0][name] for name in totals[0])


def test_the_losses_of_the_detector_by_hand():
    """A matched box is off by 1 and 0.2 pixels: 0.1 * (0.75 + 0.04) / 4."""
    built = head().detector
    truth = InstanceData(
        keypoints=torch.tensor([[10.0, 10.0, 20.0, 20.0]]), labels_3d=torch.tensor([1])
    )
    boxes = torch.tensor([[[50.0, 50.0, 60.0, 60.0], [11.0, 10.2, 20.0, 20.0]]])
    scores = torch.zeros(1, 2, 3)
    rows, cols = built.match(scores[0], boxes[0], truth, "a")
    assert (rows.tolist(), cols.tolist()) == ([1], [0])
    output = KeyPointPredictions(scores, boxes.unflatten(-1, (2, 2)))
    cls, box = built.layer_losses(output, [truth], ["a"])
    assert float(box) == pytest.approx(0.1 * (0.75 + 0.04) / 4, rel=1e-5)
    # focal of logit 0: 0.25 * 0.25 * log 2 if it is the class, else 0.75 * 0.25 * log 2
    expected = 2 * 0.25 * torch.log(torch.tensor(2.0)) * (0.25 + 5 * 0.75)
    torch.testing.assert_close(cls, expected)


def test_predictions_are_lines_of_any_number_that_their_batch_does_not_change():
    built = head().eval()
    samples = [sample(token=f"token-{i}") for i in range(3)]
    feats = bev(3)["bev_feats"]
    with torch.no_grad():
        together = built.predict({"bev_feats": feats}, samples)
        alone = [
            built.predict({"bev_feats": feats[i : i + 1]}, samples[i : i + 1]) for i in range(3)
        ]
    for found, (single,) in zip(together, alone, strict=True):
        assert torch.equal(found.num_pts, single.num_pts)
        torch.testing.assert_close(found.pts, single.pts)
        assert found.pts.shape[1:] == (6, 2)
        assert (found.num_pts >= 2).all()
        assert (found.scores_3d.diff() <= 0).all()
    numbers = torch.cat([found.num_pts for found in together])
    assert len(numbers)
    lines = elements_of_predictions(together[0]).polylines
    assert [len(line) for line in lines] == together[0].num_pts.tolist()


def test_the_detector_alone_is_a_head():
    init_default_scope("mmdet3d")
    built = MODELS.build({**DETECTOR, "grid": GRID, "classes": CLASSES}).eval()
    (found,) = built.predict(bev(), [sample()])
    assert found.pts.shape == (4, 2, 2)
    assert set(built.loss(bev(), [sample(*LINES)])) == {"loss_cls", "loss_box"}


def test_any_detector_gives_boxes():
    maptr = {**MAPTR, "grid": GRID, "classes": CLASSES}
    built = head(maptr, {**GENERATOR, "in_channels": 16})
    feats = bev(channels=16)
    elements = [MapInstance(1, torch.tensor(line).numpy()) for line in LINES]
    found = Det3DDataSample(metainfo={"token": "a"})
    targets = map_targets(elements, 5, GRID.x_range, GRID.y_range)
    found.gt_instances_3d = transformed(*LINES, gt_instances_3d=targets)
    losses = built.loss(feats, [found])
    assert {"loss_cls", "loss_pts", "loss_dir", "loss_seq"} <= set(losses)
    (lines,) = built.eval().predict(feats, [found])
    assert (lines.num_pts >= 2).all()
    points = torch.tensor([[[-5.0, 2.0], [4.0, -4.0], [0.0, 9.0]]])
    box = built.boxes(InstanceData(pts=points))[0]
    low, high = ((25 / 62, 11 / 32), (34 / 62, 24 / 32))
    assert box.tolist() == [round(200 * low[0]), round(100 * low[1]), round(200 * high[0]), 75]


def test_a_detector_by_segmentation_gives_boxes_too():
    """Lines of a head that has neither references nor queries."""
    built = head({"type": "HDMapNetHead", "embed_dims": 8, "decoder": {"base_channels": 4}}).eval()
    built.detector.lines = lambda maps: InstanceData(
        pts=torch.tensor([[[0.0, 0.0], [9.0, 3.0], [9.0, 3.0]]]),
        labels_3d=torch.tensor([1]),
        scores_3d=torch.tensor([0.7]),
        num_pts=torch.tensor([2]),
    )
    (found,) = built.predict(bev(), [sample()])
    assert found.scores_3d.tolist() == pytest.approx([0.7] * len(found))
    assert found.pts.shape[1:] == (6, 2)
    box = built.boxes(built.detector.lines(None))[0]
    assert box.tolist() == [round(200 * 30 / 62), round(100 * 15 / 32), round(200 * 39 / 62), 56]


def test_levels_of_odd_sizes_are_added_and_all_are_needed():
    torch.manual_seed(0)
    encoder = HeightPlanesEncoder(GRID, (0.0,), 7.5, embed_dims=4, num_levels=3, neck_dims=4)
    feats = [torch.randn(1, 2, 4, *size) for size in ((9, 15), (5, 8), (3, 4))]
    assert encoder.merge_levels(feats).shape == (1, 2, 4, 9, 15)
    even = [torch.randn(1, 1, 4, 12 >> i, 20 >> i) for i in range(3)]
    whole = even[0].flatten(0, 1)
    for level, blocks in zip(even[1:], encoder.upsampling, strict=True):
        image = level.flatten(0, 1)
        for block in blocks:  # twice the size, as released
            image = torch.nn.functional.interpolate(
                block(image), scale_factor=2.0, mode="bilinear", align_corners=True
            )
        whole = whole + image
    torch.testing.assert_close(encoder.merge_levels(even)[0], whole, rtol=0, atol=1e-6)
    with pytest.raises(ValueError, match="built for 3 levels of image features, got 2"):
        encoder.merge_levels(feats[:2])


def test_the_graph_of_two_stages_is_refused_with_the_reason():
    model = SimpleNamespace(lidar_encoder=None, map_head=head())
    with pytest.raises(ValueError, match="VectorMapNetHead cannot be exported: polylines are"):
        ExportedDetector(model)


def test_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="give canvas to VectorMapNetHead alone"):
        head({**DETECTOR, "canvas": {"margin_m": 1.0}})
    with pytest.raises(ValueError, match="unfold_classes has no effect"):
        head({**DETECTOR, "coder": {"unfold_classes": [0]}})
    plain = Det3DDataSample(metainfo={"token": "token-7"})
    plain.gt_instances_3d = InstanceData(labels_3d=torch.zeros(0))
    with pytest.raises(ValueError, match="'token-7' has no key points: add FormatPolylineTargets"):
        head().loss(bev(), [plain])
    with pytest.raises(ValueError, match="give both the same pixel_m and margin_m"):
        head(canvas={"margin_m": 0.0}).loss(bev(), [sample(*LINES)])


def test_a_pipeline_without_targets_is_refused_before_training():
    cfg = read_config(CONFIG)
    check_config(cfg)
    pipeline = cfg.train_dataloader.dataset.pipeline
    cfg.train_dataloader.dataset.pipeline = [
        step for step in pipeline if step.type != "FormatPolylineTargets"
    ]
    with pytest.raises(ValueError, match="needs the targets of FormatPolylineTargets"):
        check_config(cfg)


def test_the_detectors_targets_are_needed_too():
    cfg = read_config(CONFIG)
    cfg.model.map_head.detector.type = "MapHead"
    cfg.model.map_head.detector.losses = [{"type": "QueryMaskLoss"}]
    with pytest.raises(ValueError, match="MapHead needs the targets of FormatMapTargets"):
        check_config(cfg)
    cfg.train_dataloader.dataset.pipeline.insert(-1, {"type": "FormatMapTargets"})
    with pytest.raises(ValueError, match="QueryMaskLoss needs the targets of MakeInstanceMasks"):
        check_config(cfg)


def test_a_point_is_seen_where_it_projects_to_and_no_camera_gives_zero():
    encoder = HeightPlanesEncoder(GRID, (0.0, 1.0), 7.5, embed_dims=4, num_levels=1, neck_dims=4)
    assert encoder.planes.shape == (3, 2, 4, 8)
    assert encoder.planes[:, 1, -1, -1].tolist() == [30.0, 15.0, 1.0]
    columns = torch.arange(8.0).expand(1, 1, 4, 4, 8)
    matrix = torch.zeros(1, 1, 4, 4)  # u = (x + 30) / 60 of 8 pixels, v = 2 of 4, depth 1
    matrix[0, 0, 0, 0], matrix[0, 0, 0, 3], matrix[0, 0, 1, 3] = 8 / 60, 4.0, 2.0
    matrix[0, 0, 2, 3] = 1.0
    seen = encoder.project(matrix, (4, 8))
    planes = encoder.sample_planes(columns, seen)
    u = 8 * (encoder.planes[0] + 30) / 60
    inside = (u > 0) & (u < 8)
    torch.testing.assert_close(planes[0, 0][inside], (u - 0.5)[inside])
    assert (planes[0, 0][~inside] == 0).all()
    matrix[0, 0, 2, 3] = -1.0
    assert (encoder.sample_planes(columns, encoder.project(matrix, (4, 8))) == 0).all()


def test_the_published_model_has_the_published_parameters():
    cfg = Config.fromfile("configs/vectormapnet/vectormapnet_r50_130e.py")
    init_default_scope("mmdet3d")
    model = MODELS.build(cfg.model)
    idle = 4 * 128 + 256 + 3 * 256  # of the release, without effect
    found = sum(p.numel() for p in model.parameters() if p.requires_grad)
    assert found + idle == 36_734_549
    assert isinstance(model.map_head.detector, KeyPointHead)
    assert FormatMapTargets().num_points == 20


def test_it_has_no_memory_of_queries_or_elements():
    with pytest.raises(ValueError, match="VectorMapNetHead can have no memory of queries"):
        StreamMemory(head(), queries={"num": 2})
    with pytest.raises(ValueError, match="needs a head with Gaussians, got VectorMapNetHead"):
        StreamMemory(head(), elements={})
