"""Every config: known keys, a short leaf, and a model that trains and predicts one step."""

# Over 400 lines: one list of configs, and every check that all of them must pass.
import pickle
import re
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from height_cases import write_raised
from method_cases import cases_of_methods
from mmdet3d.models.layers.spconv import IS_SPCONV2_AVAILABLE
from mmdet3d.registry import DATASETS, METRICS, MODELS
from mmengine.config import Config, ConfigDict
from mmengine.dataset import pseudo_collate
from mmengine.registry import init_default_scope
from mmengine.structures import InstanceData
from unset_weights import unset_weights

import gsmap.registered  # noqa: F401
from gsmap.checkpoints.strict import neutral_keys
from gsmap.datasets.annotations.record import UNITED
from gsmap.datasets.transforms.map_targets import map_targets
from gsmap.engine.launch import check_config, read_config
from gsmap.engine.targets import share_settings
from gsmap.structures.grid import BEVGrid, padded_size
from mapdata.nuscenes.convert import NuScenesOptions, convert_nuscenes

REPO = Path(__file__).resolve().parents[1]
BASELINES = REPO / "configs"
CONFIGS = sorted(
    path for folder in (BASELINES, REPO / "projects/GSMap/configs") for path in folder.rglob("*.py")
)
LEAVES = [path for path in CONFIGS if "_base_" not in path.parts]
# lines of no equal numbers of points
ANY_NUMBER = tuple(cases_of_methods("ANY_NUMBER"))
NUMBERED = ("PivotHead", "VectorMapNetHead", "HDMapNetHead")  # that say how many points count
SWAPPABLE = [
    path for path in LEAVES if path.is_relative_to(BASELINES) and path.parent.name not in ANY_NUMBER
]
TIED = ("PivotBEVEncoder", "ViewTransformEncoder")  # to the images' size
names = pytest.mark.parametrize("path", LEAVES, ids=lambda path: path.stem)


@cache
def read(path: Path) -> bytes:
    """Read a config once, as bytes: a copy takes a third of the time of ``deepcopy``."""
    cfg = Config.fromfile(path)
    share_settings(cfg)
    return pickle.dumps(cfg)


def load(path: Path) -> Config:
    """Return a config of one's own to change."""
    init_default_scope("mmdet3d")
    return pickle.loads(read(path))


def distinct(paths: list[Path]) -> list[Path]:
    """Return one leaf of each model and data set; other schedules train the same step."""
    chosen: dict[str, Path] = {}
    for path in paths:
        cfg = load(path)
        parts = cfg.model, cfg.train_dataloader.dataset, cfg.test_dataloader.dataset
        chosen.setdefault(repr([part.to_dict() for part in parts]), path)
    return list(chosen.values())


def depth(path: Path) -> int:
    """Return how many files there are in the longest chain of a config, itself included."""
    bases = Config._get_base_files(str(path))
    return 1 + max((depth(path.parent / base) for base in bases), default=0)


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: str(path.relative_to(REPO)))
def test_configs_inherit_at_most_three_deep(path):
    assert depth(path) <= (1 if "_base_" in path.parts else 3)


@names
def test_a_leaf_is_short_and_passes_the_checks_of_the_tools(path):
    code = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    assert len([line for line in code if line.strip()]) <= 20
    cfg = read_config(path)
    check_config(cfg)
    cfg.train_cfg.max_epochs += 1  # the learning rate follows
    check_config(cfg)


def test_a_parsed_config_is_copied_for_each_use(tmp_path):
    """Files of the repository are parsed once per process, others each time."""
    path = BASELINES / "maptr/maptr_r18_minicity.py"
    changed = Config.fromfile(path)
    changed.model.map_head.type = "Other"
    assert Config.fromfile(path).model.map_head.type == "MapHead"
    own = tmp_path / "own.py"
    for number in (1, 2):
        own.write_text(f"_base_ = '{path}'\nnumber = {number}\n")
        cfg = Config.fromfile(own)
        assert cfg.number == number
        assert cfg.model == Config.fromfile(path).model
        assert cfg.text.count("_base_ = ") == 2


def coordinates(cfg: Config) -> int:
    """Return how many coordinates the points of a config's model have."""
    return cfg.model.map_head.get("reference", {}).get("coords", 2)


@names
def test_data_and_model_agree(path):
    cfg = load(path)
    assert cfg.model.grid == cfg.grid  # the one place
    assert cfg.model.classes == cfg.classes
    for part in ("train", "val", "test"):
        dataset = cfg[f"{part}_dataloader"].dataset
        assert dataset.grid == cfg.grid
        assert dataset.classes == cfg.classes
        assert dataset.get("dim", 2) == coordinates(cfg)
    assert METRICS.build(cfg.test_evaluator).eval == ("chamfer", "raster")


@names
def test_the_auxiliary_bev_mask_is_as_large_as_the_bev_features(path):
    cfg = load(path)
    heads = {head.type for head in cfg.model.map_head.get("aux_heads", [])}
    steps = {step.type: step for step in cfg.train_dataloader.dataset.pipeline}
    assert ("BEVMaskHead" in heads) <= ("MakeBEVMask" in steps)
    assert bool(heads & {"PVMaskHead", "NormedPVMaskHead"}) == ("MakePVMask" in steps)
    assert ("DepthSupervision" in heads) == ("MakeDepthMap" in steps)
    if "BEVMaskHead" in heads:
        cells = BEVGrid(**cfg.grid).rasterized(cfg.model.bev_encoder.bev_pixel_m)
        assert tuple(steps["MakeBEVMask"].size) == (cells.height, cells.width)


@names
def test_loaded_points_are_transformed_to_the_annotation_frame(path):
    """Annotation files may be in another frame than the LiDAR (``--frame ego``)."""
    cfg = load(path)
    for part in ("train", "val", "test"):
        steps = [step.type for step in cfg[f"{part}_dataloader"].dataset.pipeline]
        if "LoadLidarPoints" in steps:
            assert steps[steps.index("LoadLidarPoints") + 1] == "PointsToFrame"
            assert steps.count("PointsToFrame") == 1


@pytest.mark.parametrize("path", SWAPPABLE, ids=lambda path: path.stem)
def test_one_word_makes_a_gsmap_of_any_config(path):
    cfg, swapped = load(path), load(path)
    cfg.model.map_head.type = "MapHead"  # a method's name gives way, with the losses that it brings
    swapped.merge_from_dict({"model.map_head.type": "GSMapHead"})
    shared = {"grid": BEVGrid(**cfg.grid), "classes": cfg.classes}
    with unset_weights():
        plain, gsmap_head = (MODELS.build({**shared, **c.model.map_head}) for c in (cfg, swapped))
    assert list(gsmap_head.losses) == [*plain.losses, "raster"]
    assert len(gsmap_head.assigner.match_costs) == len(plain.assigner.match_costs) + 1
    assert gsmap_head.query_groups == plain.query_groups
    assert list(gsmap_head.aux_heads) == list(plain.aux_heads)
    layers = gsmap_head.decoder.layers, plain.decoder.layers
    for guided, layer in zip(*layers, strict=True):
        assert guided.guidance is not None
        assert type(guided.self_attn) is type(layer.self_attn)
        assert type(guided.cross_attn) is type(layer.cross_attn)
    neutral = set(gsmap_head.state_dict()) - set(plain.state_dict())
    assert set(plain.state_dict()) <= set(gsmap_head.state_dict())
    assert neutral == set().union(*neutral_keys(gsmap_head))
    half_pixel = gsmap_head.masks.half_pixel_m
    assert gsmap_head.reference.space.min_scale_m == half_pixel


def small(cfg: Config) -> Config:
    """Keep a config's structure, with two decoder layers and no weights from elsewhere.

    There are few queries and channels of the backbone, and cells of the features of the map are
    twice as wide.
    Images of a fixed size become a quarter as large, others half as large, and with them feature
    maps whose pixels all attend to each other: at full size a step takes gigabytes and minutes.
    """
    for part in (cfg.model.get("img_backbone"), cfg.model.get("img_neck")):
        if part:
            part.init_cfg = None
            if part.type == "BiFPN":
                part.size = (6, 14)
    shrink_backbone(cfg.model)
    head = cfg.model.map_head
    if head.type == "HDMapNetHead":  # before it has learned, every pixel of its maps is a line
        head.pixel_m, cfg.model.bev_encoder.bev_pixel_m = 0.6, 1.2
        cfg.train_dataloader.dataset.pipeline[2].pixel_m = 0.6
    else:
        head.get("detector", head).decoder.num_layers = 2
        shrink_queries(cfg.model)
        shrink_cells(cfg)
    encoder = cfg.model.get("bev_encoder") or {}
    if encoder.get("type") in ("PivotBEVEncoder", "BezierBEVEncoder"):
        encoder.num_layers = (1, 1)  # over the cameras, and of the features of the map
    if "num_cams" in encoder:
        encoder.num_cams = 6  # MiniCity's
    prior_layer = ((cfg.model.get("prior") or {}).get("bev") or {}).get("layer") or {}
    if "num_cams" in prior_layer:
        prior_layer.num_cams = 6
    shrink_images(cfg)
    return cfg


def shrink_backbone(model: ConfigDict) -> None:
    """Divide the channels of ResNets and Swin Transformers by four, and keep all of their stages.

    `benchmarks parameters` and the golden quantities hold the published widths.
    """
    backbone = model.get("img_backbone") or {}
    neck = model.get("img_neck") or {}
    if "in_channels" not in neck:
        return
    if backbone.type == "mmdet.ResNet":
        backbone.base_channels = backbone.get("base_channels", 64) // 4
    elif backbone.type == "mmdet.SwinTransformer":
        backbone.embed_dims //= 4
        backbone.depths = (2, 2, 2, 2)
    else:  # its name says its widths
        return
    neck.in_channels = [channels // 4 for channels in neck.in_channels]


def shrink_queries(model: ConfigDict) -> None:
    """Keep a dozen queries of each group or class, some of which streams remember.

    Lines that are generated point by point become short, by two layers.
    """
    head = model.map_head
    for group in head.get("query_groups", []):
        group.num = min(group.num, 12)
    if head.type == "PivotHead":  # lines of each class, and their points
        head.queries = [(min(lines, 12), points) for lines, points in head.queries]
    elif head.type == "BezierHead":
        head.queries = [12] * len(model.classes)
    elif head.type == "VectorMapNetHead":
        head.detector.num_queries = 12
        head.detector.coder.max_num = 12
        head.generator.update(num_layers=2, max_points=8)
    decoder = model.map_head.get("decoder") or {}
    if "num_masks" in decoder:  # one of each query
        decoder.num_masks = sum(group.num for group in model.map_head.query_groups)
    remembered = (model.get("temporal") or {}).get("queries")
    if remembered:
        remembered.num = min(remembered.num, 4)


def shrink_cells(cfg: Config) -> None:
    """Make fine cells of features of the map, and masks of their size, twice as wide."""
    encoder = cfg.model.get("bev_encoder") or {}
    if encoder.get("type") in ("PivotBEVEncoder", "BezierBEVEncoder"):
        encoder.bev_pixel_m = 1.875  # as in their small models
    if cfg.model.map_head.type == "BezierHead":
        cfg.model.map_head.bev_pixel_m = 0.9375
    if encoder.get("bev_pixel_m", 1.0) >= 1.0 or "lidar_encoder" in cfg.model:
        return
    encoder.bev_pixel_m *= 2
    cells = BEVGrid(**cfg.grid).rasterized(encoder.bev_pixel_m)
    for step in cfg.train_dataloader.dataset.pipeline:
        if step.type in ("MakeBEVMask", "MakeInstanceMasks") and "size" in step:
            step.size = (cells.height, cells.width)


def shrink_images(cfg: Config) -> None:
    """Make images of a fixed size a quarter as large, and others half as large."""
    for part in ("train", "test"):
        for step in cfg[f"{part}_dataloader"].dataset.pipeline:
            if step.type == "ScaleImages" and "scale" in step:
                step.scale /= 2
            if step.type == "ScaleImages" and "size" in step:
                width, height = step.size = tuple(side // 4 for side in step.size)
                if cfg.model.bev_encoder.type in TIED:
                    cfg.model.bev_encoder.image_size = padded_size((height, width), 32)
                encoder = cfg.model.bev_encoder
                if encoder.type == "BezierBEVEncoder" and "position_size" not in encoder:
                    encoder.position_size = (height, width)  # of images not cut yet
            if step.type == "CropImages":
                step.top //= 4


@pytest.fixture(scope="module")
def annotations(minicity_root: Path, tmp_path_factory) -> Callable[[ConfigDict], Path]:
    """Find the annotation file that fits a data set's range, classes, split and coordinates.

    Each is MiniCity converted as the data set's own data would be, once per range, class list and
    rule of the crossings.
    """
    folders: dict[tuple, Path] = {}

    def find(dataset: ConfigDict) -> Path:
        x_range, y_range = tuple(dataset.grid.x_range), tuple(dataset.grid.y_range)
        rule = dataset.get("crossings") or UNITED
        wanted = x_range, y_range, tuple(dataset.classes), rule
        if wanted not in folders:
            folders[wanted] = tmp_path_factory.mktemp("annotations")
            options = NuScenesOptions(
                minicity_root, "v1.0-trainval", dataset="minicity", out_dir=folders[wanted]
            )
            ranges = {"x_range": x_range, "y_range": y_range}
            convert_nuscenes(replace(options, **ranges, classes=wanted[2], crossings=rule))
        flat = folders[wanted] / f"gsmap_minicity_{dataset.split}.arrow"
        if dataset.get("dim", 2) == 2:
            return flat
        return write_raised(flat, flat.with_name(f"heights_{dataset.split}.arrow"))

    return find


def on_minicity(dataset: ConfigDict, root: Path, annotations: Callable[[ConfigDict], Path]) -> None:
    """Let a data set's config read MiniCity."""
    dataset.update(data_root=str(root), ann_file=str(annotations(dataset)))
    dataset.update(frame="lidar", cameras=None, rate_hz=None)


def check_gradients(model: torch.nn.Module, losses: dict[str, torch.Tensor]) -> None:
    """Go backward and check that there are gradients, all finite."""
    total, _ = model.parse_losses(losses)
    total.backward()
    gradients = [p.grad for p in model.parameters() if p.grad is not None]
    assert all(torch.isfinite(gradient).all() for gradient in gradients)
    assert sum(float(gradient.abs().sum()) for gradient in gradients) > 0


README = REPO / "README.md"
SETTINGS = {  # every line of the table in GSMap's README, with another value than by default
    "reference.literal_covariance": True,
    "reference.activation": "exp",
    "reference.max_scale_m": 8.0,
    "reference.min_scale_m": 0.3,
    "reference.init_scales_m": [2.0, 0.5],
    "reference.mlp": True,
    "decoder.detach_reference": False,
    "decoder.layer.guide_sampling": False,
    "decoder.layer.invariant_frame": True,
    "decoder.layer.embed_gaussians": False,
    "masks.source": "points",
    "masks.line_width_m": 1.0,
    "masks.filled_classes": [1],
    "masks.held_classes": [1],
    "coder.unfold_classes": [0, 2],
    "masks.pixel_m": 0.6,
    "masks.cost_pixel_m": 1.2,
    "loss_raster.alpha": 1.0,
    "loss_raster.foreground_weight": 5.0,
    "loss_raster.normalize": "foreground",
    "loss_raster.kind": "iou",
    "loss_raster.last_layer_only": True,
    "query_groups.1.losses": ["cls", "pts", "dir"],
    "query_groups.1.repeats": 3,
    "iou_cost.weight": 10.0,
    "iou_cost.kind": "dice",
    "points_weight": [1.0, 5.0, 1.0],
    "losses.1.loss_weight": [0.05, 0.005, 0.05],
    "loss_raster.full_iou": [0.0, 0.15, 0.0],
}


@pytest.mark.parametrize("base", cases_of_methods("ALL_SETTINGS").values())
def test_each_line_of_the_table_of_departures_is_a_setting(base):
    text = (REPO / "projects/GSMap/README.md").read_text()
    table = text[text.index("| point |") :].split("\n\n")[0]
    cells = [line.split("|")[-2] for line in table.splitlines()]
    named = {name for cell in cells for name in re.findall(r"`([a-z_]+[\w.]*)`", cell)}
    assert {name for name in named if not name.startswith("train_dataloader")} == set(SETTINGS)
    for name, value in SETTINGS.items():
        cfg = load(REPO / base)
        overlap = {"loss_raster.type": "MaskOverlapLoss"} if name == "loss_raster.kind" else {}
        options = {f"model.map_head.{key}": v for key, v in {name: value, **overlap}.items()}
        cfg.merge_from_dict(options)  # what --cfg-options does
        shared = {"grid": BEVGrid(**cfg.grid), "classes": cfg.classes}
        with unset_weights():
            MODELS.build({**shared, **cfg.model.map_head})


SWAPPED_BASES = ["maptr/maptr_r18_minicity"]
for _bases in cases_of_methods("SWAPPED_BASES").values():
    SWAPPED_BASES += _bases


@pytest.mark.parametrize("base", SWAPPED_BASES)
def test_the_lines_in_the_readme_make_the_gsmap_that_one_word_makes(base, tmp_path):
    text = README.read_text()
    (code,) = re.findall(r"```python\n(_base_ = 'your_maptr_config.py'.*?)```", text, re.DOTALL)
    path = tmp_path / "gsmap.py"
    path.write_text(code.replace("your_maptr_config.py", str(BASELINES / f"{base}.py")))
    older, short = load(path), load(BASELINES / f"{base}.py")
    short.merge_from_dict({"model.map_head.type": "GSMapHead"})
    shared = {"grid": BEVGrid(**short.grid), "classes": short.classes}
    heads = [MODELS.build({**shared, **cfg.model.map_head}) for cfg in (older, short)]
    assert repr(heads[0]) == repr(heads[1])
    assert [vars(cost) for cost in heads[0].assigner.match_costs] == [
        vars(cost) for cost in heads[1].assigner.match_costs
    ]
    assert heads[0].losses["raster"].loss_weight == heads[1].losses["raster"].loss_weight == 10


SWAPPED = [path for path in SWAPPABLE if "minicity" in path.stem]


@pytest.mark.parametrize("path", SWAPPED, ids=lambda path: path.stem)
def test_the_gsmap_of_one_word_trains_a_step(path, minicity_root, annotations):
    cfg = small(load(path))
    cfg.merge_from_dict({"model.map_head.type": "GSMapHead"})
    train = cfg.train_dataloader.dataset
    on_minicity(train, minicity_root, annotations)
    model = MODELS.build(cfg.model)
    model.init_weights()
    batch = pseudo_collate([DATASETS.build(train)[0]])
    losses = model.train()(**model.data_preprocessor(batch, True), mode="loss")
    assert losses["loss_raster"] > 0
    assert "at_floor" in losses
    check_gradients(model, losses)


def init_in_place(model):
    """Initialise weights as a runner does: after it took them to a GPU, where they must stay."""
    where = {name: value.data_ptr() for name, value in model.state_dict().items()}
    model.init_weights()
    assert where == {name: value.data_ptr() for name, value in model.state_dict().items()}


@pytest.mark.parametrize("path", distinct(LEAVES), ids=lambda path: path.stem)
def test_one_step_of_training_and_testing(path, minicity_root, annotations):
    cfg = small(load(path))
    train, test = (cfg[f"{part}_dataloader"].dataset for part in ("train", "test"))
    on_minicity(train, minicity_root, annotations)
    on_minicity(test, minicity_root, annotations)
    lidar = cfg.model.get("lidar_encoder")
    sparse = bool(lidar) and lidar.middle_encoder.type == "SparseEncoder"
    if sparse and not IS_SPCONV2_AVAILABLE:
        pytest.skip("the sparse LiDAR encoder needs spconv on a CPU")
    torch.manual_seed(0)
    model = MODELS.build(cfg.model)
    init_in_place(model)
    model.train()
    batch = pseudo_collate([DATASETS.build(train)[0]])  # through the config's own pipeline
    data = model.data_preprocessor(batch, True)
    if sparse:
        with pytest.raises(RuntimeError, match="trains on a GPU only"):
            model(**data, mode="loss")
    else:
        check_gradients(model, model(**data, mode="loss"))

    model.eval()
    dataset = DATASETS.build(test)
    batch = pseudo_collate([dataset[0]])
    with torch.no_grad():
        samples = model.test_step(batch)
    metric = METRICS.build(cfg.test_evaluator)
    metric.dataset_meta = dataset.metainfo
    metric.process(batch, [sample.to_dict() for sample in samples])
    figures = metric.evaluate(1)
    assert 0 <= figures["chamfer/mAP"] <= 1
    for name in test.classes:  # AP_raster leaves out what the ground truth does not have
        assert 0 <= figures[f"chamfer/{name}/AP"] <= 1
    predicted = samples[0].pred_instances_3d
    head = cfg.model.map_head
    most = {"BezierHead": 100}.get(head.type, 20)
    if head.type == "PivotHead":
        most = max(number for _, number in head.queries)
    elif head.type == "VectorMapNetHead":
        most = head.generator.max_points
    elif head.type == "HDMapNetHead":  # as many as the longest line has
        most = max([2, *predicted.num_pts.tolist()])
    assert predicted.pts.shape[1:] == (most, coordinates(cfg))
    assert ("num_pts" in predicted) == (head.type in NUMBERED)
    assert ("scales" in predicted) == ("GSMap" in cfg.model.map_head.type)


REMEMBERING = [p for p in LEAVES if p.parent.name in ANY_NUMBER and "minicity" in p.stem]


@pytest.mark.parametrize("path", REMEMBERING, ids=lambda path: path.stem)
def test_any_head_can_remember_the_features_of_the_map(path, minicity_root, annotations):
    """A sample comes again half a second later: its memory counts, in training and testing."""
    cfg = small(load(path))
    train, test = (cfg[f"{part}_dataloader"].dataset for part in ("train", "test"))
    on_minicity(train, minicity_root, annotations)
    on_minicity(test, minicity_root, annotations)
    cfg.model.temporal = {"bev": {}, "embed_dims": cfg.model.bev_encoder.get("embed_dims", 64)}
    torch.manual_seed(0)
    model = MODELS.build(cfg.model)
    model.init_weights()
    model.train()
    for dataset, mode in ((train, "loss"), (test, "tensor")):
        sample, found = DATASETS.build(dataset)[0], []
        for number in range(2):
            again = deepcopy(sample)
            again["data_samples"].set_metainfo({"timestamp_ns": number * 500_000_000})
            data = model.data_preprocessor(pseudo_collate([again]), mode == "loss")
            with model.over_time(
                model.extract_feat(data["inputs"], data["data_samples"]), data["data_samples"]
            ) as batch:
                outputs = batch.outputs
                found.append(outputs["bev_feats"].detach())
                if mode == "loss":
                    check_gradients(model, model.map_head.loss(outputs, data["data_samples"]))
                    assert model.temporal.bev.convz.weight.grad.abs().sum() > 0
                else:
                    (elements,) = model.map_head.predict(outputs, data["data_samples"])
                    assert elements.pts.isfinite().all()
        assert not torch.allclose(*found)
        model.eval()


def test_extended_classes_become_targets_that_both_metrics_score(minicity_root, annotations):
    cfg = load(REPO / "configs/maptr/maptr_r50_extended_24e.py")
    train, test = (cfg[f"{part}_dataloader"].dataset for part in ("train", "test"))
    on_minicity(train, minicity_root, annotations)
    on_minicity(test, minicity_root, annotations)
    targets = [data["data_samples"].gt_instances_3d for data in DATASETS.build(train)]
    labels = torch.cat([target.labels_3d for target in targets])
    closed = torch.cat([target.closed for target in targets])
    extended = labels >= 3
    assert extended.any()
    assert closed[extended].all()
    assert int(labels.max()) < len(cfg.model.classes) == len(train.classes) == 6

    dataset = DATASETS.build(test)
    metric = METRICS.build(cfg.test_evaluator)
    metric.dataset_meta = dataset.metainfo
    found: set[str] = set()
    for idx, data in enumerate(dataset):  # the ground truth itself stands in for a prediction
        sample = data["data_samples"]
        truth = map_targets(dataset.sample(idx).instances, 20, sample.x_range, sample.y_range)
        sample.pred_instances_3d = InstanceData(
            pts=truth.pts, labels_3d=truth.labels_3d, scores_3d=torch.ones(len(truth))
        )
        metric.process(None, [sample.to_dict()])
        found |= {test.classes[label] for label in truth.labels_3d.tolist()}
    figures = metric.evaluate(len(dataset))
    assert found & set(test.classes[3:])
    for name in found & set(test.classes[3:]):
        assert figures[f"chamfer/{name}/AP"] == pytest.approx(1)
        assert figures[f"raster/{name}/AP"] > 0.9  # 20 points do not hold every corner


STEPS_OF_IMAGES = {
    "maptr/maptr_r50_24e": ["DistortImages", "ScaleImages"],
    "maptr/maptr_r50_second_24e": ["DistortImages", "ScaleImages"],
}
for _steps in cases_of_methods("STEPS_OF_IMAGES").values():
    STEPS_OF_IMAGES |= _steps


@pytest.mark.parametrize(("name", "steps"), STEPS_OF_IMAGES.items())
def test_colours_are_distorted_before_or_after_scaling_as_in_the_original(name, steps):
    pipeline = load(REPO / f"configs/{name}.py").train_dataloader.dataset.pipeline
    assert [step.type for step in pipeline if step.type in steps] == steps
