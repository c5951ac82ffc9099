"""Configs in the form of the original repositories become ours, and what has no place is named."""

import re
from pathlib import Path

import pytest
import torch
import upstream_configs
from method_cases import cases_of_methods
from mmdet3d.registry import MODELS
from mmengine.config import Config
from mmengine.optim import build_optim_wrapper
from processes import run_tool
from upstream_configs import BASE, converted

from gsmap.engine.launch import check_config, read_config
from mapdata.upstream_configs.fields import Fields
from mapdata.upstream_configs.reader import read_assignments
from mapdata.upstream_configs.upstream import convert_upstream, python_text
from tools.convert_config import convert

REPO = Path(__file__).resolve().parents[2]
# our config -> the config of the authors, and the settings that differ
CONFIGS = {
    "maptr/maptr_r50_24e": (upstream_configs.maptr(), set()),
    "maptr/maptr_r50_av2_6e": (upstream_configs.maptr_av2(), set()),
}
for _configs in cases_of_methods("UPSTREAM_CONFIGS").values():
    CONFIGS |= _configs
# our config -> the config of the authors whose head equals its head
HEADS: dict[str, str] = {}
for _heads in cases_of_methods("UPSTREAM_HEADS").values():
    HEADS |= _heads


def plain(value):
    """Let lists equal tuples."""
    if isinstance(value, dict):
        return {key: plain(inner) for key, inner in value.items()}
    return [plain(inner) for inner in value] if isinstance(value, (list, tuple)) else value


def differences(ours, theirs, path=""):
    """Yield the dotted names at which two configs differ."""
    if isinstance(ours, dict) and isinstance(theirs, dict):
        for key in ours.keys() | theirs.keys():
            yield from differences(ours.get(key), theirs.get(key), f"{path}.{key}".lstrip("."))
    elif plain(ours) != plain(theirs):
        yield path


@pytest.mark.parametrize("ours", CONFIGS)
def test_the_papers_configs_become_the_ones_that_are_here(ours, tmp_path):
    text, expected = CONFIGS[ours]
    cfg, unplaced = converted(text, tmp_path)
    wanted = read_config(REPO / f"configs/{ours}.py")
    differing = set(differences(wanted.to_dict(), cfg.to_dict()))
    found = {name for name in differing if not name.startswith("_")}  # no parts of the config
    spelt_out = {  # ours has the same as a default
        "model.bev_encoder.cross_attn.num_heads",
        "model.bev_encoder.embed_dims",
        "model.bev_encoder.with_can_bus",
        "model.img_neck.start_level",
        "model.map_head.coder.margin_m",
        "model.map_head.decoder.layer.self_attn",
        "model.img_backbone.init_cfg.checkpoint",  # the same weights, by their address
    }
    by_cores = {f"{part}_dataloader.num_workers" for part in ("train", "val", "test")}
    assert all(cfg[name.partition(".")[0]].num_workers in (4, "cores") for name in by_cores)
    assert found - spelt_out - by_cores == expected
    assert unplaced == [BASE]


@pytest.mark.parametrize("ours", HEADS)
def test_a_method_becomes_the_same_head(ours, tmp_path):
    cfg, unplaced = converted(HEADS[ours], tmp_path)
    wanted = read_config(REPO / f"configs/{ours}.py")
    check_config(cfg)
    with torch.device("meta"):
        heads = [MODELS.build(each.model).map_head for each in (cfg, wanted)]
    for part in ("losses", "aux_heads"):
        values = [
            {k: {**vars(m), "_modules": None} for k, m in getattr(head, part).items()}
            for head in heads
        ]
        assert str(values[0]) == str(values[1])
    costs = [[(type(c), vars(c)) for c in head.assigner.match_costs] for head in heads]
    assert str(costs[0]) == str(costs[1])
    shapes = [{k: v.shape for k, v in head.state_dict().items()} for head in heads]
    assert shapes[0] == shapes[1]
    assert heads[0].query_groups == heads[1].query_groups
    assert cfg.optim_wrapper.optimizer == wanted.optim_wrapper.optimizer
    assert cfg.auto_scale_lr == wanted.auto_scale_lr
    assert cfg.train_cfg.max_epochs == wanted.train_cfg.max_epochs
    assert cfg.param_scheduler == wanted.param_scheduler
    assert cfg.model.img_backbone.frozen_stages == wanted.model.img_backbone.frozen_stages
    assert unplaced == [BASE]


def test_settings_of_ones_own_arrive(tmp_path):
    more = "fp16 = dict(loss_scale=512.)\nfind_unused_parameters = True\ncudnn_benchmark = True"
    text = upstream_configs.maptr(queries="num_vec=70,", scale=0.4, epochs=30, more=more)
    text = text.replace("points = 20", "points = 30")
    cfg, _ = converted(text, tmp_path)
    assert cfg.model.map_head.query_groups == [{"num": 70}]
    assert cfg.model.map_head.num_points == 30
    for part in ("train", "val", "test"):
        steps = {step.type: step for step in cfg[f"{part}_dataloader"].dataset.pipeline}
        assert steps["ScaleImages"].scale == 0.4
        if part == "train":
            assert steps["FormatMapTargets"].num_points == 30
    assert cfg.train_cfg.max_epochs == 30
    assert "T_max" not in cfg.param_scheduler[1]  # as long as the training
    assert cfg.optim_wrapper.type == "AmpOptimWrapper"
    assert cfg.optim_wrapper.loss_scale == 512
    assert cfg.find_unused_parameters
    assert cfg.env_cfg.cudnn_benchmark


@pytest.mark.parametrize(("x_m", "y_m"), [(30.0, 15.0), (15.0, 30.0), (50.0, 25.0)])
def test_the_data_set_is_the_one_of_the_type_at_any_range(x_m, y_m, tmp_path):
    range_m = f"[-{x_m}, -{y_m}, -2.0, {x_m}, {y_m}, 2.0]"
    templates = {"nuscenes": upstream_configs.maptr, "av2": upstream_configs.maptr_av2}
    for data_set, template in templates.items():
        cfg, _ = converted(template(range_m=range_m), tmp_path)
        assert cfg.train_dataloader.dataset.ann_file == f"gsmap_{data_set}_train.arrow"
        assert cfg.model.grid == {"x_range": [-x_m, x_m], "y_range": [-y_m, y_m]}


def test_another_data_set_of_validation_is_named(tmp_path):
    other = "**{**shared, 'type': 'CustomAV2LocalMapDataset'}"
    text = upstream_configs.maptr().replace("_gpu=1, **shared", f"_gpu=1, {other}")
    _, unplaced = converted(text, tmp_path)
    assert unplaced == [BASE, "data.val.type = 'CustomAV2LocalMapDataset'"]


def test_what_has_no_place_is_named_with_its_value(tmp_path):
    collect = "dict(type='CustomCollect3D"
    text = (
        upstream_configs.maptr()
        .replace("dir_interval=1", "dir_interval=2")
        .replace("weight=0.0, box_format", "weight=0.25, box_format")
        .replace("policy='CosineAnnealing'", "policy='step'")
        .replace(collect, f"dict(type='MixUp', alpha=0.3), {collect}")
        .replace("type='MapTR',", "type='MapTR', modality='fusion', lidar_encoder=dict(a=1),")
    )
    _, unplaced = converted(text, tmp_path)
    assert set(unplaced) == {
        BASE,
        "model.modality = 'fusion'",
        "model.lidar_encoder.a = 1",
        "model.pts_bbox_head.dir_interval = 2",
        "model.train_cfg.pts.assigner.reg_cost.type = 'BBoxL1Cost'",
        "model.train_cfg.pts.assigner.reg_cost.weight = 0.25",
        "model.train_cfg.pts.assigner.reg_cost.box_format = 'xywh'",
        "data.train.pipeline.6.type = 'MixUp'",
        "data.train.pipeline.6.alpha = 0.3",
        "lr_config.policy = 'step'",
    }


@pytest.mark.parametrize(
    ("theirs", "other", "named"),
    [
        ("test_mode=False", "test_mode=True", ["model.video_test_mode"]),
        ("'Learned", "'Sine", ["model.pts_bbox_head.positional_encoding.type"]),
        ("num_classes=len(map_classes), in", "num_classes=5, in", ["head.num_classes"]),
        ("3, 5), num_levels=1", "3, 5), num_levels=4", ["attn_cfgs.1.attention.num_levels"]),
        ("'norm', 'ffn', 'norm')", "'ffn', 'norm')", ["transformerlayers.operation_order"] * 2),
        ("MultiViewImage')", "MultiViewImage', hue_delta=9)", ["train.pipeline.1.hue_delta"]),
        ("size_divisor=32", "size=(480, 800)", ["pipeline.4.size", "transforms.1.size"]),
        ("type='Custom", "queue_length=4, {}", ["data.train.queue_length", "val.queue_length"]),
        ("type='Custom", "load_interval=9, {}", ["data.train.load_interval", "val.load_interval"]),
    ],
)
def test_what_has_one_value_here_is_named_with_any_other(theirs, other, named, tmp_path):
    text = upstream_configs.maptr()
    assert theirs in text
    _, unplaced = converted(text.replace(theirs, other.format(theirs)), tmp_path)
    for name in named:
        assert any(f"{name} = " in line for line in unplaced)


def test_lists_are_as_good_as_tuples_and_absent_settings_as_none(tmp_path):
    order = "('self_attn', 'norm', 'cross_attn', 'norm', 'ffn', 'norm')"
    text = upstream_configs.maptr().replace(order, f"[{order[1:-1]}]")
    assert "operation_order=['self_attn'" in text
    _, unplaced = converted(text, tmp_path)
    assert unplaced == [BASE]
    fields = Fields({"attention": {"type": "MultiheadAttention"}})
    fields.drop("attention", names="type", dropout=None)
    assert fields.left_over() == []


def test_every_fourth_sample_of_argoverse2_is_validated_as_in_the_releases(tmp_path):
    text = upstream_configs.maptr_av2().replace("(ann_file", "(load_interval=4, ann_file")
    _, unplaced = converted(text, tmp_path)
    assert unplaced == [BASE, "data.train.load_interval = 4"]


def test_channels_vehicle_signals_and_distortion_arrive(tmp_path):
    text = (
        upstream_configs.maptr()
        .replace("width = 256", "width = 128")
        .replace("use_can_bus=True", "use_can_bus=False")
        .replace("    dict(type='PhotoMetricDistortionMultiViewImage'),\n", "")
    )
    cfg, unplaced = converted(text, tmp_path)
    assert unplaced == [BASE]
    model = MODELS.build(cfg.model)
    assert model.bev_encoder.bev_embedding.weight.shape[1] == 128
    assert model.map_head.embed_dims == 128
    assert model.bev_encoder.can_bus_mlp is None
    steps = [step.type for step in cfg.train_dataloader.dataset.pipeline]
    assert steps == ["LoadCameraImages", "ScaleImages", "FormatMapTargets", "PackMapInputs"]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("import os", "line 2, 'import os': only assignments of names are read"),
        ("a = open('x')", r"line 2, .*calls of open\(\) are not evaluated"),
        ("a = __import__('os').system('true')", r"calls of .*\(\) are not evaluated"),
        ("a = [x for x in (1, 2)]", "expressions such as .* are not evaluated"),
        ("a = b", "the name b is not assigned in an earlier line"),
        ("a = 'x' * 1000000000", "only numbers can be multiplied"),
        ("a = (1).real", "expressions such as .* are not evaluated"),
        ("a, b = 1, 2", "only assignments of names are read"),
        ("a = b[0] = 1", "only assignments of names are read"),
        ("a = f'{1}'", "expressions such as .* are not evaluated"),
        ("a = 1 / 0", "division by zero"),
        ("a = [1][3]", "list index out of range"),
        ("a =", "line 2: invalid syntax"),
    ],
)
def test_what_is_more_than_assignments_is_refused_and_never_run(line, message, tmp_path):
    source = tmp_path / "theirs.py"
    source.write_text(f"first = 1\n{line}\n")
    with pytest.raises(ValueError, match=message):
        read_assignments(source)


def test_what_is_written_says_what_was_placed_and_is_quick(tmp_path):
    cfg, _ = converted(upstream_configs.maptr(), tmp_path)
    tree = "it's {a}"
    for _ in range(12):
        tree = {"a": tree, "b-c": tree}
    cfg.model.img_backbone.more = tree
    target = tmp_path / "ours.py"
    target.write_text(python_text(cfg))
    written = Config.fromfile(target, import_custom_modules=False).to_dict()
    assert written == {k: v for k, v in cfg.to_dict().items() if not k.startswith("_")}


def test_values_that_are_read(tmp_path):
    source = tmp_path / "theirs.py"
    source.write_text(
        '"""Text."""\na = [1, 2.5]\nb = dict(x=a, **dict(y=(len(a), -a[0])))\n'
        "c = {'k': b['y'], 'r': 7 // 2 / 2.0}\nd = 'data/' + 'x.pkl'\na = a + [3]\ne = f = a\n"
    )
    values = read_assignments(source)
    assert values == {
        "a": [1, 2.5, 3],
        "b": {"x": [1, 2.5], "y": (2, -1)},
        "c": {"k": (2, -1), "r": 1.5},
        "d": "data/x.pkl",
        "e": [1, 2.5, 3],
        "f": [1, 2.5, 3],
    }
    assert values["e"] is not values["f"]


def test_a_config_of_another_model_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"^MapTracker is not supported: model\.type must be one"):
        converted(upstream_configs.maptr(model="MapTracker"), tmp_path)
    with pytest.raises(ValueError, match=r"data\.train\.type must be one of .* got 'Mine'"):
        converted(upstream_configs.maptr(dataset="Mine"), tmp_path)
    start = upstream_configs.maptr().replace("type='ResNet'", "type='VoVNet', spec_name='V-19-dw'")
    with pytest.raises(ValueError, match=r"of V-19-dw with .*'stage5'.* must be V-19-eSE"):
        converted(start.replace("out_indices=(3,)", "out_features=['stage5']"), tmp_path)
    stem = start.replace("-dw", "-eSE").replace("out_indices=(3,)", "out_features=['stem']")
    with pytest.raises(ValueError, match=r"\['stem'\] is not supported: .* some of stage2, "):
        converted(stem, tmp_path)
    bare = "model = dict(type='MapTR')\n"
    with pytest.raises(ValueError, match=r"None is not supported: model\.pts_bbox_head\.type"):
        converted(bare, tmp_path)


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        ("MapTRHead", "MapQRHead"),
        ("BEVFormerEncoder", "UNetEncoder"),
        ("GeometrySptialCrossAttention", "HeightKernelAttention"),
        ("DetrTransformerDecoderLayer", "MapQRDecoderLayer"),
        ("MultiheadAttention", "OtherAttention"),
        ("CustomMSDeformableAttention", "InstancePointAttention"),
    ],
)
def test_a_part_that_ours_does_not_have_is_refused(ours, theirs, tmp_path):
    text = upstream_configs.maptr()
    assert ours in text
    with pytest.raises(
        ValueError, match=rf"^{theirs} is not supported: \S+ must be one of .*{ours}"
    ):
        converted(text.replace(ours, theirs), tmp_path)


@pytest.mark.parametrize(
    ("backbone", "wanted"),
    [
        (
            "type='VoVNet', spec_name='V-19-eSE', input_ch=3, out_features=['stage5'])",
            {"type": "VoVNet", "depth": 19, "out_indices": (3,)},
        ),
        (
            "type='SwinTransformer', embed_dims=96, init_cfg=None)",
            {"type": "mmdet.SwinTransformer", "embed_dims": 96, "init_cfg": None},
        ),
        ("type='ResNet', depth=18)", {"type": "mmdet.ResNet", "depth": 18}),
    ],
)
@pytest.mark.parametrize("pretrained", ["", "pretrained=None,", "pretrained=dict(img='a.pth'),"])
def test_another_backbone_has_no_settings_of_ours(backbone, wanted, pretrained, tmp_path):
    text = upstream_configs.maptr()
    start = text.index("    pretrained=")
    stop = text.index("    img_neck=")
    text = f"{text[:start]}{pretrained} img_backbone=dict({backbone},\n{text[stop:]}"
    cfg, _ = converted(text, tmp_path)
    if "img" in pretrained:
        wanted = {**wanted, "init_cfg": {"type": "Pretrained", "checkpoint": "a.pth"}}
    assert cfg.model.img_backbone == wanted
    MODELS.build(cfg.model.img_backbone)


def test_maptr_on_depth_pooled_features_stays_maptr(tmp_path):
    lift = upstream_configs.LIFT.split(", downsample")[0] + ", downsample=2)"
    settings = {**upstream_configs.LIFTED, "encoder": lift, "keys": "['img']"}
    cfg, unplaced = converted(upstream_configs.maptr(**settings), tmp_path)
    wanted = read_config(REPO / "configs/maptr/maptr_r50_bevpool_24e.py")
    with torch.device("meta"):
        models = [MODELS.build(each.model) for each in (cfg, wanted)]
    shapes = [{k: v.shape for k, v in model.state_dict().items()} for model in models]
    assert shapes[0] == shapes[1]
    assert models[0].bev_encoder.camera_aware is False
    assert unplaced == [BASE]
    settings["dataset"] = "CustomAV2OfflineLocalMapDataset"
    with pytest.raises(ValueError, match="LSSTransform of MapTR is not supported on Argoverse 2"):
        converted(upstream_configs.maptr(**settings), tmp_path)


def test_the_command_writes_a_config_that_the_tools_read(tmp_path):
    source, target = tmp_path / "theirs.py", tmp_path / "new/ours.py"
    text = upstream_configs.maptr(queries="num_vec=70,")
    source.write_text(text.replace("dir_interval=1", "dir_interval=2"))
    words = ["tools/convert_config.py", source, target]
    run = run_tool(*words)
    assert run.returncode == 2
    assert "another model, since 1 of its settings have no counterpart: model.pts_b" in run.stderr
    assert not target.exists()
    words.append("--allow-changes")
    run = run_tool(*words)
    assert run.returncode == 0, run.stderr
    assert "configs/maptr/maptr_r50_24e.py" in run.stdout
    of_model, others = run.stdout.split("other settings without a counterpart")
    assert "this is another model, without the settings" in of_model
    assert "  model.pts_bbox_head.dir_interval = 2" in of_model
    assert "  _base_ = " in others
    cfg = read_config(target)
    check_config(cfg)
    assert cfg.model.map_head.query_groups == [{"num": 70}]
    source.write_text("import os\n")
    run = run_tool(*words)
    assert run.returncode == 2
    assert "error:" in run.stderr


def test_what_only_blocks_a_kernel_or_switches_heights_off_has_no_effect(tmp_path):
    """As in the nano configs of MapTR, and in configs of later methods on Argoverse 2."""
    maptr = upstream_configs.maptr()
    blocked = maptr.replace("num_levels=1)", "num_levels=1, im2col_step=192)")
    assert blocked.count("im2col_step") == 3
    cfg, unplaced = converted(
        blocked.replace(
            "'TemporalSelfAttention', embed_dims=width, num_levels=1, im2col_step=192",
            "'TemporalSelfAttention', embed_dims=width",
        ),
        tmp_path,
    )
    assert cfg.to_dict() == converted(maptr, tmp_path)[0].to_dict()
    assert unplaced == [BASE]
    flat = with_heights(maptr, False)
    cfg, unplaced = converted(flat, tmp_path)
    assert cfg.to_dict() == converted(maptr, tmp_path)[0].to_dict()
    assert unplaced == [BASE]
    _, unplaced = converted(with_heights(maptr, True), tmp_path)
    assert "model.pts_bbox_head.z_cfg.pred_z_flag = True" in unplaced


def with_heights(text: str, heights: bool) -> str:
    """Say in each place where the originals do whether points have heights."""
    of_points = f"z_cfg=dict(pred_z_flag={heights}, gt_z_flag={heights}), "
    for part in ("Assigner', ", "NMSFreeCoder', ", "PerceptionTransformer', "):
        assert part in text
        text = text.replace(part, part + of_points)
    text = text.replace("Head',\n", f"Head', {of_points}\n")
    text = text.replace("type='CustomNuScenes", f"{of_points}type='CustomNuScenes")
    assert text.count("z_cfg") == 5
    return text


@pytest.mark.parametrize(
    ("theirs", "other", "section"),
    [
        ("OrderedPtsL1Cost", "OrderedPtsSmoothL1Cost", "train_cfg.pts.assigner.pts_cost"),
        ("FocalLossCost", "ClassificationCost", "train_cfg.pts.assigner.cls_cost"),
        ("MapTRAssigner", "MySimOTAAssigner", "train_cfg.pts.assigner"),
        ("PtsL1Loss", "OrderedPtsSmoothL1Loss", "pts_bbox_head.loss_pts"),
        ("PtsDirCosLoss", "MyOwnDirectionLoss", "pts_bbox_head.loss_dir"),
        ("MapTRNMSFreeCoder", "MyRealNMSCoder", "pts_bbox_head.bbox_coder"),
        ("MapTRNMSFreeCoder", "NMSFreeCoder", "pts_bbox_head.bbox_coder"),  # it decodes 3D boxes
        ("MapTRPerceptionTransformer", "MyTransformer", "pts_bbox_head.transformer"),
        ("MapTRDecoder", "MyFancyDecoder", "pts_bbox_head.transformer.decoder"),
        ("MapTRDecoder", "DetectionTransformerDecoder", "pts_bbox_head.transformer.decoder"),
    ],
)
def test_a_type_with_one_counterpart_is_named_with_any_other(theirs, other, section, tmp_path):
    text = upstream_configs.maptr()
    assert text.count(f"type='{theirs}'") == 1
    text = text.replace(f"type='{theirs}'", f"type='{other}'")
    _, unplaced = converted(text, tmp_path)
    assert set(unplaced) == {BASE, f"model.{section}.type = '{other}'"}
    target = tmp_path / "ours.py"
    with pytest.raises(ValueError, match=f"another model.*{section}.type = '{other}'"):
        convert(tmp_path / "theirs.py", target)
    assert not target.exists()
    assert f"{section}.type = '{other}'" in convert(
        tmp_path / "theirs.py", target, allow_changes=True
    )


# Types without an effect: of losses and costs whose weight is zero, and of the order of samples.
WITHOUT_EFFECT = {"L1Loss", "GIoULoss", "BBoxL1Cost", "IoUCost", "DistributedGroupSampler"}


@pytest.mark.parametrize("ours", {**CONFIGS, **HEADS})
def test_no_type_in_the_configs_of_the_papers_is_dropped_unseen(ours, tmp_path):
    """Each one becomes another, which the converted config has or a message names."""
    text = CONFIGS[ours][0] if ours in CONFIGS else HEADS[ours]
    source = tmp_path / "theirs.py"
    unseen = set()
    for kind in set(re.findall(r"type='(\w+)'", text)) - {"l1"}:
        source.write_text(text.replace(f"type='{kind}'", "type='Another'"))
        try:
            conversion = convert_upstream(read_assignments(source))
            found = f"{conversion.settings} {conversion.unplaced}"
        except ValueError as error:
            found = str(error)
        if "Another" not in found:
            unseen.add(kind)
    assert unseen <= WITHOUT_EFFECT


OTHER_RANGE = "pc_range=[0.0, 0.0, -2.0, 9.0, 9.0, 2.0]"


@pytest.mark.parametrize(
    ("theirs", "other", "named"),
    [
        ("pc_range=range_m, max_num", f"{OTHER_RANGE}, max_num", "bbox_coder.pc_range = [0.0, "),
        ("pc_range=range_m))))", f"{OTHER_RANGE}))))", "pts.assigner.pc_range = [0.0, "),
        ("pc_range=range_m, num_points", f"{OTHER_RANGE}, num_points", "encoder.pc_range = [0.0, "),
        ("4], num_classes=len(map_classes))", "4], num_classes=9)", "bbox_coder.num_classes = 9"),
        ("return_intermediate=True", "return_intermediate=False", "decoder.return_intermediate"),
        ("return_intermediate=False", "return_intermediate=True", "encoder.return_intermediate"),
        ("metric='chamfer'", "metric='iou'", "evaluation.metric = 'iou'"),
        # without the setting, the original has another default
        ("query_embed_type='instance_pts',", "", "head.query_embed_type = 'all_pts'"),
        ("gt_shift_pts_pattern='v2',", "", "head.gt_shift_pts_pattern = 'v0'"),
        ("with_box_refine=True,", "", "head.with_box_refine = False"),
    ],
)
def test_a_setting_that_changes_the_model_is_named(theirs, other, named, tmp_path):
    text = upstream_configs.maptr()
    assert text.count(theirs) == 1
    _, unplaced = converted(text.replace(theirs, other), tmp_path)
    assert len(unplaced) == 2
    assert any(named in line for line in unplaced)


@pytest.mark.parametrize(
    ("theirs", "other", "named"),
    [
        ("voxel_size=[0.15, 0.15, 20.0]", "voxel_size=[0.15, 0.15, 4.0]", "encoder.voxel_size"),
        ("grid_config=depth", "grid_config=dict(depth=[1, 9, 1])", "encoder.grid_config.depth"),
        ("dict(type='CustomC", "dict(type='CustomPointToMultiViewDepth', downsample=4), {}", "ple"),
    ],
)
def test_a_setting_that_changes_lifting_by_depth_is_named(theirs, other, named, tmp_path):
    text = upstream_configs.maptr(**upstream_configs.LIFTED)
    assert text.count(theirs) == 1
    _, unplaced = converted(text.replace(theirs, other.format(theirs)), tmp_path)
    assert len(unplaced) == 2
    assert any(named in line for line in unplaced)


SCALE = "    dict(type='RandomScaleImageMultiViewImage', scales=[0.5]),\n"
NORMALISE = "    dict(type='NormalizeMultiviewImage', **norm),\n"
PAD = "    dict(type='PadMultiViewImage', size_divisor=32),\n"
TESTED = "transforms=[train_pipeline[3], train_pipeline[4]]"
OF_TEST = "transforms=[{}, train_pipeline[4]]"
PARAMWISE = "paramwise_cfg=dict(custom_keys={'img_backbone': dict(lr_mult=0.1)}),"
WARM_UP = "warmup='linear', warmup_iters=500, warmup_ratio=1.0 / 3,"
LINEAR = {"type": "LinearLR", "by_epoch": False, "begin": 0, "end": 500, "start_factor": 1 / 3}
COSINE = {"type": "CosineAnnealingLR", "by_epoch": True, "eta_min_ratio": 1e-3}


def without(*parts: str) -> str:
    """The config of MapTR without these parts of its text."""
    text = upstream_configs.maptr()
    for part in parts:
        assert part in text
        text = text.replace(part, "")
    return text


def replaced(theirs: str, other: str) -> str:
    """The config of MapTR with another part."""
    text = upstream_configs.maptr()
    assert theirs in text
    return text.replace(theirs, other)


def no_scale() -> str:
    """The config of MapTR without a step that scales images."""
    return without(SCALE).replace(TESTED, "transforms=[train_pipeline[3]]")


def scales(cfg: Config) -> list[float | None]:
    """Scale of the images in training, validation and test; None without a step."""
    found = []
    for part in ("train", "val", "test"):
        steps = {step.type: step for step in cfg[f"{part}_dataloader"].dataset.pipeline}
        found.append(steps["ScaleImages"].scale if "ScaleImages" in steps else None)
    return found


SCALED = "dict(type='RandomScaleImageMultiViewImage', scales=[{}])"
VAL_PIPELINE = f"val_pipeline = [{SCALED.format(0.4)}]\ndata_root = 'data"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (no_scale(), [None, None, None]),
        (replaced(TESTED, OF_TEST.format(SCALED.format(0.8))), [0.5, 0.8, 0.8]),
        (replaced(TESTED, "transforms=[train_pipeline[4]]"), [0.5, None, None]),
        (
            replaced("data_root = 'data", VAL_PIPELINE).replace(
                "pipeline=test_pipeline, samples", "pipeline=val_pipeline, samples"
            ),
            [0.5, 0.4, 0.5],
        ),
        (replaced("pipeline=test_pipeline, samples", "samples"), [0.5, 0.5, 0.5]),
    ],
)
def test_each_pipeline_has_the_scale_of_the_file(text, expected, tmp_path):
    cfg, _ = converted(text, tmp_path)
    assert scales(cfg) == expected


@pytest.mark.parametrize(
    ("theirs", "other", "named"),
    [
        ("scales=[0.5]", "scales=[0.5, 0.7]", ["train.pipeline.3.scales", "val.pipeline.2.transf"]),
        (TESTED, OF_TEST.format(f"{SCALED.format(0.5)}, {SCALED.format(0.9)}"), ["transforms.1.s"]),
        ("flip=False", "flip=True", ["val.pipeline.2.flip = True", "test.pipeline.2.flip = True"]),
        ("scale=(1600, 900)", "scale=[(1600, 900), (800, 450)]", ["val.pipeline.2.img_scale"]),
        ("scale_ratio=1", "scale_ratio=0.5", ["test.pipeline.2.pts_scale_ratio = 0.5"]),
        (TESTED, "transforms=[train_pipeline[3]]", ["data.test.pipeline.PadMultiViewImage = None"]),
        (TESTED, OF_TEST.format("train_pipeline[1], train_pipeline[3]"), ["'PhotoMetric"]),
    ],
)
def test_steps_that_cannot_be_converted_are_named(theirs, other, named, tmp_path):
    cfg, unplaced = converted(replaced(theirs, other), tmp_path)
    assert scales(cfg) == [0.5, 0.5, 0.5]
    for name in named:
        assert any(name in line for line in unplaced)


def test_images_without_a_step_are_neither_normalised_nor_padded(tmp_path):
    text = without(NORMALISE, PAD).replace(TESTED, "transforms=[train_pipeline[2]]")
    cfg, unplaced = converted(text, tmp_path)
    assert unplaced == [BASE]
    images = torch.rand(1, 1, 3, 450, 800) * 255
    preprocessor = MODELS.build(cfg.model.data_preprocessor)
    torch.testing.assert_close(preprocessor.normalise(images), images)


def test_another_normalisation_of_the_test_is_named(tmp_path):
    first, second = upstream_configs.maptr().split("test_pipeline = [")
    for other, named in (("", "NormalizeMultiviewImage = None"), ("mean", "'mean': [1, 2, 3]")):
        step = NORMALISE.replace("**norm", "mean=[1, 2, 3], std=[1, 1, 1]") if other else ""
        text = f"{first}test_pipeline = [{second.replace(NORMALISE, step)}"
        cfg, unplaced = converted(text, tmp_path)
        assert cfg.model.data_preprocessor.mean == [123.675, 116.28, 103.53]
        for part in ("val", "test"):
            assert any(f"data.{part}" in line and named in line for line in unplaced)


def test_padding_to_another_multiple_arrives(tmp_path):
    text = upstream_configs.maptr(**upstream_configs.LIFTED).replace("divisor=32", "divisor=64")
    cfg, unplaced = converted(text, tmp_path)
    assert unplaced == [BASE]
    assert cfg.model.data_preprocessor.pad_size_divisor == 64


@pytest.mark.parametrize(
    ("theirs", "other", "expected"),
    [
        (WARM_UP, "", [COSINE]),
        (WARM_UP, "warmup=None, warmup_iters=500,", [COSINE]),
        (", warmup_ratio=1.0 / 3", "", [{**LINEAR, "start_factor": 0.1}, COSINE]),
        ("min_lr_ratio=1e-3", "min_lr_ratio=0.0", [LINEAR, {**COSINE, "eta_min_ratio": 0.0}]),
        (
            "min_lr_ratio=1e-3",
            "min_lr=1e-6",
            [LINEAR, {"type": "CosineAnnealingLR", "by_epoch": True, "eta_min": 1e-6}],
        ),
        (f"CosineAnnealing', {WARM_UP}\n    min_lr_ratio=1e-3", f"fixed', {WARM_UP}", [LINEAR]),
        (f"policy='CosineAnnealing', {WARM_UP}\n    min_lr_ratio=1e-3", "", []),
        (
            f"CosineAnnealing', {WARM_UP}\n    min_lr_ratio=1e-3",
            "step', step=[20, 22]",
            [{"type": "MultiStepLR", "by_epoch": True, "milestones": [20, 22], "gamma": 0.1}],
        ),
    ],
)
def test_the_learning_rate_follows_the_file(theirs, other, expected, tmp_path):
    cfg, unplaced = converted(replaced(theirs, other), tmp_path)
    assert [scheduler.to_dict() for scheduler in cfg.param_scheduler] == expected
    assert unplaced == [BASE]
    check_config(cfg)


def test_an_optimizer_without_other_sections_has_none_of_ours(tmp_path):
    """One rate for all parameters, which stays constant, and no clipping."""
    text = upstream_configs.maptr()
    start = text.index("optimizer_config = ")
    stop = text.index("total_epochs = ")
    text = f"{text[:start]}{text[stop:]}".replace(PARAMWISE, "")
    cfg, unplaced = converted(text, tmp_path)
    assert unplaced == [BASE]
    assert cfg.param_scheduler == []
    assert cfg.optim_wrapper.clip_grad is None
    wrapper = build_optim_wrapper(
        torch.nn.ModuleDict({"img_backbone": torch.nn.Linear(2, 2)}), cfg.optim_wrapper
    )
    assert [group["lr"] for group in wrapper.optimizer.param_groups] == [6e-4]
    check_config(cfg)


def test_a_file_without_a_schedule_keeps_ours_and_a_message_says_so(tmp_path):
    text = upstream_configs.maptr()
    start = text.index("optimizer = ")
    stop = text.index("evaluation = ")
    text = f"{text[:start]}{text[stop:]}"
    runner = "runner = dict(type='EpochBasedRunner', max_epochs=total_epochs)\n"
    assert runner in text
    cfg, unplaced = converted(text.replace(runner, ""), tmp_path)
    wanted, _ = converted(upstream_configs.maptr(), tmp_path)
    assert cfg.to_dict() == wanted.to_dict()
    assert unplaced == [BASE, "optimizer = None", "total_epochs = None"]


def test_what_a_schedule_cannot_have_here_is_named(tmp_path):
    constructor = "type='AdamW', constructor='LayerDecayOptimizerConstructor',"
    _, unplaced = converted(replaced("type='AdamW',", constructor), tmp_path)
    assert unplaced == [BASE, "optimizer.constructor = 'LayerDecayOptimizerConstructor'"]
    _, unplaced = converted(replaced("warmup='linear'", "warmup='exp'"), tmp_path)
    assert "lr_config.warmup = 'exp'" in unplaced
    with pytest.raises(ValueError, match=r"lr_config\.min_lr_ratio is missing"):
        converted(replaced("min_lr_ratio=1e-3", ""), tmp_path)
