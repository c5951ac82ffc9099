"""A config of MapTR, MapTRv2, GeMap or MapVR in their authors' form, as settings of ours."""

import math
import re
from dataclasses import dataclass
from pathlib import Path
from pprint import pformat
from typing import Any

from mmengine.config import Config

from gsmap.utils.errors import InputError
from mapdata.upstream_configs.data import FLAT, data_settings, schedule_settings
from mapdata.upstream_configs.fields import Fields

_KEY = re.compile(r"[a-zA-Z][\w.-]*", re.ASCII)
_TYPE = re.compile(r"(mmdet\.)?\w+")
METHODS = ("MapTR", "MapTRv2", "GeMap", "GeMapFull")
# top-level names that mean something by themselves; others are variables of the file
RUN = (
    "_base_", "model", "data", "optimizer", "optimizer_config", "lr_config", "total_epochs",
    "runner", "evaluation", "fp16", "checkpoint_config", "log_config", "load_from",
    "resume_from", "custom_hooks", "momentum_config",
)  # fmt: skip
_HEAD = "model.map_head."
_DECODER = _HEAD + "decoder."
_BEV = "model.bev_encoder."
# theirs
_THEIRS = "model.pts_bbox_head"
_TRAINING = "model.train_cfg.pts"
_COSTS = f"{_TRAINING}.assigner"
_TRANSFORMER = f"{_THEIRS}.transformer"
_ENCODER = f"{_TRANSFORMER}.encoder"
_PILLARS = f"{_ENCODER}.transformerlayers"
_SPATIAL = f"{_PILLARS}.attn_cfgs.1"  # after the temporal attention
_LAYER = f"{_TRANSFORMER}.decoder.transformerlayers"
MOVED = {
    f"{_TRANSFORMER}.decoder.num_layers": _DECODER + "num_layers",
    f"{_LAYER}.feedforward_channels": _DECODER + "layer.ffn_dims",
    f"{_LAYER}.ffn_dropout": _DECODER + "layer.dropout",
    f"{_THEIRS}.num_pts_per_vec": _HEAD + "num_points",
    f"{_THEIRS}.bbox_coder.max_num": _HEAD + "coder.max_num",
    f"{_THEIRS}.loss_cls": _HEAD + "loss_cls",
    f"{_THEIRS}.loss_pts.loss_weight": _HEAD + "losses.0.loss_weight",
    f"{_THEIRS}.loss_dir.loss_weight": _HEAD + "losses.1.loss_weight",
    f"{_COSTS}.cls_cost.weight": _HEAD + "match_costs.0.weight",
    f"{_COSTS}.pts_cost.weight": _HEAD + "match_costs.1.weight",
}
MOVED_OF_PILLARS = {
    f"{_ENCODER}.num_layers": _BEV + "num_layers",
    f"{_PILLARS}.feedforward_channels": _BEV + "layer_cfg.ffn_dims",
    f"{_PILLARS}.ffn_dropout": _BEV + "layer_cfg.dropout",
}
# the kinds of parts that ours has, too
KINDS: dict[str, tuple[str, ...]] = {
    "model": METHODS,
    _THEIRS: tuple(f"{method}Head" for method in METHODS),
    _ENCODER: ("BEVFormerEncoder", "LSSTransform"),
    _LAYER: ("DetrTransformerDecoderLayer", "DecoupledDetrTransformerDecoderLayer"),
}
_SELF_ATTENTIONS = ("MultiheadAttention", "GeometryDecoupledAttention")
_CROSS_ATTENTIONS = ("CustomMSDeformableAttention",)
_SPATIAL_ATTENTIONS = ("GeometrySptialCrossAttention", "SpatialCrossAttention")
# what only ever has one value, and is that of ours
FIXED: dict[str, dict[str, Any]] = {
    _THEIRS: {
        "query_embed_type": "instance_pts", "transform_method": "minmax",
        "gt_shift_pts_pattern": "v2", "with_box_refine": True, "as_two_stage": False,
        "sync_cls_avg_factor": True, "code_size": 2, "dir_interval": 1, "z_cfg": FLAT,
    },
    f"{_THEIRS}.aux_seg": {"seg_classes": 1, "use_aux_seg": True},
    f"{_ENCODER}.depthnet_cfg": {"use_dcn": False, "with_cp": False},
    f"{_SPATIAL}.attention": {"dilation": 1},
    **{section: {"z_cfg": FLAT} for section in (f"{_THEIRS}.bbox_coder", _TRANSFORMER, _COSTS)},
}  # fmt: skip
# parts that do nothing if this weight of theirs is zero
WEIGHTS = {
    f"{_THEIRS}.loss_bbox": "loss_weight", f"{_THEIRS}.loss_iou": "loss_weight",
    f"{_COSTS}.reg_cost": "weight", f"{_COSTS}.iou_cost": "weight",
}  # fmt: skip
# what has no meaning of its own: ours follows from other settings
DROPPED = {
    "model": "type video_test_mode",
    _THEIRS: "type num_query in_channels code_weights num_classes positional_encoding",
    f"{_THEIRS}.bbox_coder": "type pc_range voxel_size num_classes",
    f"{_THEIRS}.aux_seg": "feat_down_sample pv_thickness",
    **dict.fromkeys([f"{_THEIRS}.loss_{name}" for name in ("pts", "dir", "seg", "pv_seg")], "type"),
    _TRAINING: "grid_size voxel_size point_cloud_range out_size_factor",
    _COSTS: "type pc_range",
    **dict.fromkeys([f"{_COSTS}.cls_cost", f"{_COSTS}.pts_cost"], "type"),
    _TRANSFORMER: "type rotate_prev_bev use_shift use_can_bus embed_dims",
    _ENCODER: "pc_range return_intermediate voxel_size grid_config in_channels",
    _PILLARS: "type operation_order",
    f"{_PILLARS}.attn_cfgs.0": "type embed_dims num_levels",
    _SPATIAL: "embed_dims pc_range num_cams",
    f"{_SPATIAL}.attention": "type embed_dims num_levels im2col_step",
    f"{_SPATIAL}.deformable_attention": "type embed_dims num_levels im2col_step",
    f"{_TRANSFORMER}.decoder": "type return_intermediate",
    _LAYER: "operation_order num_vec num_pts_per_vec",
}


@dataclass
class Conversion:
    """What a config becomes."""

    base: str  # our config that it is nearest to, below configs
    settings: dict[str, Any]  # by dotted names of ours
    steps: dict[str, dict[str, Any]]  # settings of pipeline steps, by their type
    unplaced: list[str]  # what has no place in ours: dotted name and value


def convert_upstream(names: dict[str, Any]) -> Conversion:
    """Turn the assignments of an original config, which are used up, into settings of ours.

    Raises:
        ValueError: If the config is of a model, or of a data set with it, that ours is not.
    """
    fields = Fields({name: names[name] for name in RUN if name in names})
    for section, kinds in KINDS.items():
        _check_kind(fields, section, kinds)
    settings = data_settings(fields) | schedule_settings(fields) | _image_settings(fields)
    sides = *settings["grid"]["x_range"], *settings["grid"]["y_range"]
    encoder = _encoder_settings(fields, settings, sides)
    settings |= fields.move(MOVED)
    _decoder_settings(fields, settings)
    _head_settings(fields, settings)
    _margin(fields, settings, sides)
    for section, weight in WEIGHTS.items():
        if fields.section(section).get(weight) == 0:
            fields.section(section).clear()
    for section in {**DROPPED, **FIXED}:
        fields.drop(section, DROPPED.get(section, ""), **FIXED.get(section, {}))
    base = _base(encoder, sides[0] == -30.0, settings.pop("with_depth"))
    return Conversion(base, settings, settings.pop("steps"), fields.left_over())


def _check_kind(fields: Fields, section: str, kinds: tuple[str, ...]) -> None:
    """Refuse a part that ours does not have."""
    kind = fields.section(section).get("type")
    if kind not in kinds:
        known = ", ".join(kinds)
        raise InputError(f"{kind!s:.60} is not supported: {section}.type must be one of {known}.")


def merge(conversion: Conversion, configs: Path) -> Config:
    """Return our config, from the folder of our configs, with the conversion's settings."""
    values = Config.fromfile(configs / conversion.base, import_custom_modules=False).to_dict()
    for name, value in conversion.settings.items():
        *path, last = name.split(".")
        section: Any = values
        for key in path:
            at_list = isinstance(section, list)
            section = section[int(key)] if at_list else section.setdefault(key, {})
        section[last] = value
    cfg = Config(values)
    for part in ("train", "val", "test"):
        for step in cfg[f"{part}_dataloader"].dataset.pipeline:
            step.update(conversion.steps.get(step.type, {}))
    return cfg


def python_text(cfg: Config) -> str:
    """Write a config as Python: each value by its ``repr``.

    Raises:
        ValueError: If a value is more than a number or text, a key is no plain word, a type is the
            path of a module, or a text is one that mmengine replaces (``{{...}}``).
    """
    # the base's own values have done their work
    values = {name: v for name, v in cfg.to_dict().items() if not name.startswith("_")}
    _check_plain(values, "")
    lines = (f"{name} = {pformat(v, width=100, sort_dicts=False)}\n" for name, v in values.items())
    return "".join(lines)


def _check_plain(value: Any, name: str) -> None:
    """Refuse what is not to stand in a config, which is code."""
    if isinstance(value, (dict, list, tuple)):
        for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
            own = f"{name}.{key}".lstrip(".")
            if isinstance(value, dict) and not (isinstance(key, str) and _KEY.fullmatch(key)):
                raise InputError(f"{own[:60]!r} is no name of a setting")
            if key == "type" and not (isinstance(inner, str) and _TYPE.fullmatch(inner)):
                raise InputError(f"{own} must be the name of a registered class, got {inner!r:.60}")
            _check_plain(inner, own)
    elif isinstance(value, str):
        if "{{" in value:
            raise InputError(f"{name} is {value!r:.60}, which mmengine would replace")
    elif not (value is None or (isinstance(value, (int, float)) and math.isfinite(value))):
        raise InputError(f"{name} is {value!r:.60}, neither a finite number nor a text")


def _base(encoder: str, av2: bool, with_depth: bool) -> str:
    """Return our config that has the same encoder and data set."""
    of_nuscenes = {"SpatialCrossAttention": "bevformer", "PlainLSSTransform": "bevpool"}
    if encoder in of_nuscenes and av2:
        raise InputError(
            f"{encoder.removeprefix('Plain')} of MapTR is not supported on Argoverse 2."
        )
    if encoder in of_nuscenes:
        return f"maptr/maptr_r50_{of_nuscenes[encoder]}_24e.py"
    if encoder == "LSSTransform":
        on_av2 = "av2_depth_6e" if with_depth else "av2_6e"
        return f"maptrv2/maptrv2_r50_{on_av2 if av2 else '24e'}.py"
    return f"maptr/maptr_r50_{'av2_6e' if av2 else '24e'}.py"


def _image_settings(fields: Fields) -> dict[str, Any]:
    """Return the settings of backbone and neck."""
    settings: dict[str, Any] = {}
    if not fields.take("model.use_grid_mask", False):
        settings["model.img_augment"] = None
    for part in ("img_backbone", "img_neck"):
        values = fields.take(f"model.{part}", {})
        kind = values["type"] if values["type"] == "VoVNet" else f"mmdet.{values['type']}"
        settings |= {f"model.{part}.{name}": v for name, v in {**values, "type": kind}.items()}
    checkpoint = fields.take("model.pretrained", {}).get("img")
    if checkpoint is not None:
        settings["model.img_backbone.init_cfg.checkpoint"] = checkpoint
    return settings


def _encoder_settings(fields: Fields, settings: dict[str, Any], sides: tuple[float, ...]) -> str:
    """Add the settings of the BEV encoder and return its kind."""
    kind: str = fields.take(f"{_ENCODER}.type")
    rows, cols = fields.take(f"{_THEIRS}.bev_h"), fields.take(f"{_THEIRS}.bev_w")
    sizes = (sides[1] - sides[0]) / cols, (sides[3] - sides[2]) / rows
    settings[_BEV + "z_range"] = tuple(settings.pop("z_range"))
    settings[_BEV + "bev_pixel_m"] = sizes[0] if abs(sizes[0] - sizes[1]) < 1e-6 else list(sizes)
    if kind == "LSSTransform":
        fields.drop(_ENCODER, "out_channels feat_down_sample", downsample=2)
        aware = {"depthnet_cfg", "loss_depth_weight"} & fields.section(_ENCODER).keys()
        if fields.section("model").get("type") == "MapTR" and not aware:
            kind = "PlainLSSTransform"  # its depth net does not read the cameras' parameters
        aspp = fields.take(f"{_ENCODER}.depthnet_cfg.aspp_mid_channels", 96)
        settings[_BEV + "depth_range"] = tuple(fields.take(f"{_ENCODER}.dbound"))
        settings[_BEV + "aspp_channels"] = aspp
        return kind
    fields.drop(_ENCODER, num_points_in_pillar=4)
    settings[_BEV + "num_cams"] = fields.take(f"{_TRANSFORMER}.num_cams", 6)
    settings |= fields.move(MOVED_OF_PILLARS)
    _check_kind(fields, _SPATIAL, _SPATIAL_ATTENTIONS)
    kind = fields.take(f"{_SPATIAL}.type")
    ours, theirs = _BEV + "cross_attn.", _SPATIAL + "."
    if kind == "GeometrySptialCrossAttention":
        settings[ours + "num_heads"] = fields.take(theirs + "attention.num_heads")
        settings[ours + "kernel_size"] = tuple(fields.take(theirs + "attention.kernel_size"))
    else:
        settings[ours + "num_points"] = fields.take(theirs + "deformable_attention.num_points", 8)
    return kind


def _decoder_settings(fields: Fields, settings: dict[str, Any]) -> None:
    """Add the settings of the decoder's attentions."""
    layer = _DECODER + "layer."
    decoupled = fields.take(f"{_LAYER}.type") == "DecoupledDetrTransformerDecoderLayer"
    first, *others, cross = fields.items(f"{_LAYER}.attn_cfgs")
    _check_kind(fields, first, _SELF_ATTENTIONS)
    _check_kind(fields, cross, _CROSS_ATTENTIONS)
    kind, heads = fields.take(first + ".type"), fields.take(first + ".num_heads")
    settings[layer + "num_heads"] = heads
    ours = "PointSelfAttention" if kind == "MultiheadAttention" else kind
    settings[layer + "self_attn.type"] = "DecoupledSelfAttention" if decoupled else ours
    fields.drop(first, "embed_dims num_ins num_pts")
    dropout = fields.section(first).get("dropout")
    for other in others:  # MapTRv2's second attention has the settings of its first
        fields.drop(other, "type embed_dims", num_heads=heads, dropout=dropout)
    fields.drop(cross, "type embed_dims num_levels im2col_step")
    # the deformable attention's own default is not the layer's
    for part, name, default in (("self_attn", first, 0.0), ("cross_attn", cross, 0.1)):
        dropout = fields.take(name + ".dropout", default)
        if dropout != settings[layer + "dropout"]:
            settings[f"{layer}{part}.dropout"] = dropout


def _head_settings(fields: Fields, settings: dict[str, Any]) -> None:
    """Add the settings of queries and losses, and the head that has them."""
    fields.drop(_THEIRS, num_pts_per_gt_vec=settings[_HEAD + "num_points"])
    settings[_HEAD + "loss_cls"] |= {"type": f"mmdet.{settings[_HEAD + 'loss_cls']['type']}"}

    def take(name: str, default: Any) -> Any:
        return fields.take(f"{_THEIRS}.{name}", default)

    num = take("num_vec_one2one", None) or fields.take(f"{_THEIRS}.num_vec")
    further = {
        "name": "one2many",
        "num": take("num_vec_one2many", 0),
        "repeats": take("k_one2many", 6),
        "weight": take("lambda_one2many", 1.0),
    }
    settings[_HEAD + "query_groups"] = [{"num": num}, further] if further["num"] else [{"num": num}]
    _mapvr_settings(fields, settings)
    if take("use_geo_loss", False):
        fields.drop(_THEIRS, "intra_loss_weight inter_loss_weight")
        fields.drop(f"{_THEIRS}.loss_geo", "type num_ins num_pts pc_range", loss_type="l1")
        settings[_HEAD + "type"] = "GeMapHead"
        settings[_HEAD + "loss_euclidean"] = {
            "loss_weight": fields.take(f"{_THEIRS}.loss_geo.loss_weight"),
            "shape_weight": take("loss_geo.intra_loss_weight", 1.0),
            "relation_weight": take("loss_geo.inter_loss_weight", 1.0),
        }
    heads: list[dict[str, Any]] = []
    for flag, kind in (("bev_seg", "BEVMaskHead"), ("pv_seg", "PVMaskHead")):
        loss = f"loss_{flag.removeprefix('bev_')}"
        weights = {name: take(f"{loss}.{name}", None) for name in ("loss_weight", "pos_weight")}
        if take(f"aux_seg.{flag}", False):
            heads.append({"type": kind, **weights})
    depth = fields.take(f"{_ENCODER}.loss_depth_weight", None)
    if depth:
        heads.append({"type": "DepthSupervision", "loss_weight": depth})
    if heads:
        settings[_HEAD + "aux_heads"] = heads


def _mapvr_settings(fields: Fields, settings: dict[str, Any]) -> None:
    """Add the settings of MapVR's rendered masks, where there are any."""
    if not fields.take(f"{_THEIRS}.loss_rendered_mask.type", None):
        return
    pts, direction = (settings[f"{_HEAD}losses.{i}.loss_weight"] for i in (0, 1))
    fields.drop(f"{_COSTS}.rendered_mask_cost", "type")
    dice = fields.take(f"{_THEIRS}.loss_rendered_mask.weight")
    settings |= {
        _HEAD + "type": "MapVRHead",
        _HEAD + "points_weight": pts,
        _HEAD + "loss_direction": {"type": "SelfDirectionLoss", "loss_weight": direction},
        _HEAD + "loss_dice": {"loss_weight": dice},
        _HEAD + "dice_cost": {"weight": fields.take(f"{_COSTS}.rendered_mask_cost.weight")},
    }
    pts_cost = settings[_HEAD + "match_costs.1.weight"]
    if pts != pts_cost:  # one weight of ours is for both
        fields.section(f"{_COSTS}.pts_cost")["weight"] = pts_cost


def _margin(fields: Fields, settings: dict[str, Any], sides: tuple[float, ...]) -> None:
    """Add how far beyond the map a detection may lie, if it is the same on all sides."""
    limits = fields.section(f"{_THEIRS}.bbox_coder").get("post_center_range", ())
    x0, x1, y0, y1 = sides
    if len(limits) != 8:
        return
    margins = {x0 - limits[0], y0 - limits[1], limits[4] - x1, limits[5] - y1}
    if len(margins) == 1 and limits[:2] == limits[2:4] and limits[4:6] == limits[6:]:
        fields.drop(f"{_THEIRS}.bbox_coder", "post_center_range")
        settings[_HEAD + "coder.margin_m"] = float(margins.pop())
