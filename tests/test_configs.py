"""Every config: known keys, a short leaf, and a model that trains and predicts one step."""

from pathlib import Path

import pytest
import torch
from mmdet3d.models.layers.spconv import IS_SPCONV2_AVAILABLE
from mmdet3d.registry import DATASETS, METRICS, MODELS
from mmengine.config import Config
from mmengine.dataset import pseudo_collate
from mmengine.registry import init_default_scope

import gsmap.registered  # noqa: F401
from gsmap.datasets.converters.nuscenes import NuScenesOptions, convert_nuscenes
from gsmap.engine.launch import check_config

REPO = Path(__file__).resolve().parents[1]
LEAVES = sorted(
    path
    for folder in (REPO / "configs", REPO / "projects/GSMap/configs")
    for path in folder.rglob("*.py")
    if "_base_" not in path.parts
)
names = pytest.mark.parametrize("path", LEAVES, ids=lambda path: path.stem)


def load(path: Path) -> Config:
    init_default_scope("mmdet3d")
    return Config.fromfile(path)


@names
def test_a_leaf_is_short_and_passes_the_checks_of_the_tools(path):
    code = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    assert len([line for line in code if line.strip()]) <= 20
    check_config(load(path))


@names
def test_data_and_model_agree(path):
    cfg = load(path)
    head = cfg.model.map_head
    for part in ("train", "val", "test"):
        dataset = cfg[f"{part}_dataloader"].dataset
        assert len(dataset.classes) == head.num_classes
        assert (
            dataset.pc_range[:2] + dataset.pc_range[3:5] == head.pc_range[:2] + head.pc_range[3:5]
        )
    encoder = cfg.model.bev_encoder or cfg.model.lidar_encoder
    if "bev_size" in encoder:  # rows lie along y, columns along x
        x_extent, y_extent = (head.pc_range[3 + i] - head.pc_range[i] for i in range(2))
        rows, cols = encoder.bev_size
        assert rows * x_extent == cols * y_extent
    assert METRICS.build(cfg.test_evaluator).eval == ("chamfer", "raster")


def small(cfg: Config) -> Config:
    """Keep a config's structure, with two decoder layers and no weights from elsewhere."""
    for part in (cfg.model.get("img_backbone"), cfg.model.get("img_neck")):
        if part:
            part.init_cfg = None
    cfg.model.map_head.decoder.num_layers = 2
    if "num_cams" in (cfg.model.get("bev_encoder") or {}):
        cfg.model.bev_encoder.num_cams = 6  # MiniCity's
    return cfg


@pytest.fixture(scope="module")
def ego_annotations(minicity_root: Path, tmp_path_factory) -> Path:
    """MiniCity converted to the range of Argoverse 2 (60 m along x)."""
    out_dir = tmp_path_factory.mktemp("ego")
    ranges = {"x_range": (-30.0, 30.0), "y_range": (-15.0, 15.0)}
    convert_nuscenes(
        NuScenesOptions(minicity_root, "v1.0-trainval", out_dir, dataset="minicity", **ranges)
    )
    return out_dir


def one_batch(cfg: Config, part: str, root: Path, ego_annotations: Path) -> dict:
    """Return a batch of one sample of MiniCity that went through the config's own pipeline."""
    dataset = cfg[f"{part}_dataloader"].dataset
    folder = ego_annotations if dataset.frame == "ego" else root
    dataset.update(
        data_root=str(root), ann_file=str(folder / f"gsmap_minicity_{dataset.split}.arrow")
    )
    dataset.update(frame="lidar", cameras=None)
    return pseudo_collate([DATASETS.build(dataset)[0]])


@names
def test_one_step_of_training_and_testing(
    path, minicity_root, minicity_annotations, ego_annotations
):
    cfg = small(load(path))
    lidar = cfg.model.get("lidar_encoder")
    if lidar and lidar.middle_encoder.type == "SparseEncoder" and not IS_SPCONV2_AVAILABLE:
        pytest.skip("the sparse LiDAR encoder needs spconv on a CPU")
    torch.manual_seed(0)
    model = MODELS.build(cfg.model)
    model.init_weights()
    model.train()
    data = model.data_preprocessor(one_batch(cfg, "train", minicity_root, ego_annotations), True)
    losses = model(**data, mode="loss")
    total, _ = model.parse_losses(losses)
    total.backward()
    gradients = [p.grad for p in model.parameters() if p.grad is not None]
    assert all(torch.isfinite(gradient).all() for gradient in gradients)
    assert sum(float(gradient.abs().sum()) for gradient in gradients) > 0

    model.eval()
    batch = one_batch(cfg, "test", minicity_root, ego_annotations)
    with torch.no_grad():
        samples = model.test_step(batch)
    metric = METRICS.build(cfg.test_evaluator)
    metric.dataset_meta = DATASETS.build(cfg.test_dataloader.dataset).metainfo
    metric.process(batch, [sample.to_dict() for sample in samples])
    figures = metric.evaluate(1)
    assert 0 <= figures["chamfer/mAP"] <= 1
    predicted = samples[0].pred_instances_3d
    assert predicted.pts.shape[1:] == (cfg.model.map_head.num_points, 2)
    assert ("scales" in predicted) == ("GSMap" in cfg.model.map_head.type)
