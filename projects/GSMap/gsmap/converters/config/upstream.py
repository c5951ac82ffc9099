"""A config of MapTR, MapTRv2, GeMap or MapVR in their authors' form, as settings of ours."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mmengine.config import Config

from gsmap.converters.config.data import data_settings, schedule_settings
from gsmap.converters.config.fields import Fields

METHODS = ("MapTR", "MapTRv2", "GeMap", "GeMapFull")
HEAD = "model.map_head."
# what only ever has one value, and is that of ours
FIXED = {
    "query_embed_type": "instance_pts",
    "transform_method": "minmax",
    "gt_shift_pts_pattern": "v2",
    "with_box_refine": True,
    "as_two_stage": False,
    "sync_cls_avg_factor": True,
    "code_size": 2,
    "dir_interval": 1,
}
ATTENTIONS = {
    "GeometryDecoupledAttention": "GeometryDecoupledAttention",
    "MultiheadAttention": "PointSelfAttention",
}


@dataclass
class Conversion:
    """What a config becomes.

    Attributes:
        base: Our config that it is nearest to, below ``configs``.
        settings: What to set in it, by dotted name.
        steps: What to set in its pipelines, by the type of the step.
        unplaced: What has no place in ours: dotted name and value.
    """

    base: str
    settings: dict[str, Any]
    steps: dict[str, dict[str, Any]]
    unplaced: list[str]


def convert_upstream(names: dict[str, Any]) -> Conversion:
    """Turn the assignments of an original config into settings of ours.

    Args:
        names: Values by name, as `read_assignments` returns them; they are used up.

    Raises:
        ValueError: If the config is of no model that is known.
    """
    model = names.get("model")
    if not isinstance(model, dict) or model.get("type") not in METHODS:
        kind = model.get("type") if isinstance(model, dict) else None
        raise ValueError(f"model.type must be one of {METHODS}, got {kind!r}.")
    fields = Fields({name: names[name] for name in Fields.RUN if name in names})
    settings = data_settings(fields)
    settings |= schedule_settings(fields)
    settings |= _image_settings(fields.section("model"))
    head = fields.section("model", "pts_bbox_head")
    x_range, y_range = settings["grid"]["x_range"], settings["grid"]["y_range"]
    settings |= _encoder_settings(head, (x_range, y_range), settings.pop("z_range"))
    settings |= _decoder_settings(head.section("transformer", "decoder"))
    settings |= _head_settings(head, fields.section("model", "train_cfg", "pts"))
    margin = _margin(head.section("bbox_coder"), (x_range, y_range))
    if margin is not None:
        settings[HEAD + "coder.margin_m"] = margin
    base = _base(settings, settings.pop("with_depth"))
    return Conversion(base, settings, settings.pop("steps"), fields.left_over())


def merge(conversion: Conversion, configs: Path) -> Config:
    """Return our config with the conversion's settings.

    Args:
        conversion: What an original config became.
        configs: The folder of our configs.
    """
    cfg = Config.fromfile(configs / conversion.base, import_custom_modules=False)
    values = cfg.to_dict()
    for name, value in conversion.settings.items():
        _assign(values, name.split("."), value)
    cfg = Config(values)
    for part in ("train", "val", "test"):
        for step in cfg[f"{part}_dataloader"].dataset.pipeline:
            step.update(conversion.steps.get(step.type, {}))
    return cfg


def _assign(values: Any, path: list[str], value: Any) -> None:
    """Set a value at a path of keys and indices; what stood there is gone."""
    for key in path[:-1]:
        values = values[int(key)] if isinstance(values, list) else values.setdefault(key, {})
    values[path[-1]] = value


def _base(settings: dict[str, Any], with_depth: bool) -> str:
    """Return our config that has the same encoder and data set."""
    encoder = settings.pop("encoder")
    av2 = settings["grid"]["x_range"] == [-30.0, 30.0]
    if encoder == "LSSTransform":
        if not av2:
            return "maptrv2/maptrv2_r50_24e.py"
        return f"maptrv2/maptrv2_r50_av2{'_depth' if with_depth else ''}_6e.py"
    if encoder == "SpatialCrossAttention":
        return "maptr/maptr_r50_bevformer_24e.py"
    return f"maptr/maptr_r50_{'av2_6e' if av2 else '24e'}.py"


def _image_settings(model: Fields) -> dict[str, Any]:
    """Return the settings of backbone and neck."""
    model.drop("type", "video_test_mode")
    settings: dict[str, Any] = {}
    if not model.take("use_grid_mask", False):
        settings["model.img_augment"] = None
    backbone = model.take("img_backbone", {})
    kind = backbone.pop("type")
    settings["model.img_backbone.type"] = kind if kind == "VoVNet" else f"mmdet.{kind}"
    settings |= {f"model.img_backbone.{name}": value for name, value in backbone.items()}
    checkpoint = model.take("pretrained", {}).get("img")
    if checkpoint is not None:
        settings["model.img_backbone.init_cfg.checkpoint"] = checkpoint
    neck = model.take("img_neck", {})
    settings["model.img_neck.type"] = f"mmdet.{neck.pop('type')}"
    return settings | {f"model.img_neck.{name}": value for name, value in neck.items()}


def _encoder_settings(head: Fields, ranges: Any, z_range: list[float]) -> dict[str, Any]:
    """Return the settings of the BEV encoder; ``encoder`` is its kind."""
    transformer = head.section("transformer")
    transformer.drop("type", "rotate_prev_bev", "use_shift", "use_can_bus", "embed_dims")
    encoder = transformer.section("encoder")
    kind = encoder.take("type")
    rows, cols = head.take("bev_h"), head.take("bev_w")
    head.drop("positional_encoding")
    (x0, x1), (y0, y1) = ranges
    name = "model.bev_encoder."
    sizes = (x1 - x0) / cols, (y1 - y0) / rows
    settings = {
        name + "z_range": tuple(z_range),
        name + "bev_pixel_m": sizes[0] if abs(sizes[0] - sizes[1]) < 1e-6 else list(sizes),
    }
    encoder.drop("pc_range", "return_intermediate", "voxel_size", "grid_config", "in_channels")
    if kind == "LSSTransform":
        encoder.only(downsample=2)
        encoder.drop("out_channels", "feat_down_sample")
        net = encoder.section("depthnet_cfg")
        net.only(use_dcn=False, with_cp=False)
        settings[name + "depth_range"] = tuple(encoder.take("dbound"))
        settings[name + "aspp_channels"] = net.take("aspp_mid_channels", 96)
        return {**settings, "encoder": kind}
    cameras = transformer.take("num_cams", 6)
    encoder.only(num_points_in_pillar=4)
    layer = encoder.section("transformerlayers")
    layer.drop("type", "operation_order")
    layer_settings = {
        "num_layers": encoder.take("num_layers"),
        "num_cams": cameras,
        "layer_cfg.ffn_dims": layer.take("feedforward_channels"),
        "layer_cfg.dropout": layer.take("ffn_dropout"),
    }
    settings |= {name + key: value for key, value in layer_settings.items()}
    temporal, cross = layer.items("attn_cfgs")
    temporal.drop("type", "embed_dims", "num_levels")
    kind = cross.take("type")
    cross.drop("embed_dims", "pc_range", "num_cams")
    if kind == "GeometrySptialCrossAttention":
        kernel = cross.section("attention")
        kernel.drop("type", "embed_dims", "num_levels")
        kernel.only(dilation=1)
        settings[name + "cross_attn.num_heads"] = kernel.take("num_heads")
        settings[name + "cross_attn.kernel_size"] = tuple(kernel.take("kernel_size"))
    elif kind == "SpatialCrossAttention":
        deformable = cross.section("deformable_attention")
        deformable.drop("type", "embed_dims", "num_levels")
        settings[name + "cross_attn.num_points"] = deformable.take("num_points", 8)
    return {**settings, "encoder": kind}


def _decoder_settings(decoder: Fields) -> dict[str, Any]:
    """Return the settings of the decoder and its layers."""
    decoder.drop("type", "return_intermediate")
    settings: dict[str, Any] = {HEAD + "decoder.num_layers": decoder.take("num_layers")}
    layer = decoder.section("transformerlayers")
    layer.drop("operation_order", "num_vec", "num_pts_per_vec")
    decoupled = layer.take("type") == "DecoupledDetrTransformerDecoderLayer"
    name = HEAD + "decoder.layer."
    dropout = layer.take("ffn_dropout")
    settings[name + "ffn_dims"] = layer.take("feedforward_channels")
    settings[name + "dropout"] = dropout
    first, *others, cross = layer.items("attn_cfgs")
    kind = first.take("type")
    settings[name + "self_attn.type"] = (
        "DecoupledSelfAttention" if decoupled else ATTENTIONS.get(kind, kind)
    )
    settings[name + "num_heads"] = first.take("num_heads")
    first.drop("embed_dims", "num_ins", "num_pts")
    for other in others:  # MapTRv2's second attention has the settings of its first
        other.drop("type", "embed_dims")
        other.only(num_heads=settings[name + "num_heads"], dropout=first.rest.get("dropout"))
    cross.drop("type", "embed_dims", "num_levels")
    for part, own in (("self_attn", first.take("dropout", 0.0)), ("cross_attn", _dropout(cross))):
        if own != dropout:
            settings[f"{name}{part}.dropout"] = own
    return settings


def _dropout(cross: Fields) -> float:
    """Return the dropout of the deformable attention, whose default is not the layer's."""
    return float(cross.take("dropout", 0.1))


def _head_settings(head: Fields, training: Fields) -> dict[str, Any]:
    """Return the settings of queries, losses and costs."""
    head.drop("type", "num_query", "in_channels", "code_weights", "num_classes")
    head.only(**FIXED)
    training.drop("grid_size", "voxel_size", "point_cloud_range", "out_size_factor")
    costs = training.section("assigner")
    costs.drop("type", "pc_range")
    for name, section in (("reg_cost", costs), ("iou_cost", costs)):
        section.drop_without_weight(name, "weight")
    for name in ("loss_bbox", "loss_iou"):
        head.drop_without_weight(name, "loss_weight")
    points = head.take("num_pts_per_vec")
    head.only(num_pts_per_gt_vec=points)
    groups = [{"num": head.take("num_vec_one2one", None) or head.take("num_vec")}]
    further = head.take("num_vec_one2many", 0)
    repeats, weight = head.take("k_one2many", 6), head.take("lambda_one2many", 1.0)
    if further:
        groups.append({"name": "one2many", "num": further, "repeats": repeats, "weight": weight})
    loss_cls = head.take("loss_cls")
    settings = {
        HEAD + "num_points": points,
        HEAD + "query_groups": groups,
        HEAD + "coder.max_num": head.section("bbox_coder").take("max_num"),
        HEAD + "loss_cls": {**loss_cls, "type": f"mmdet.{loss_cls['type']}"},
    }
    settings |= _loss_settings(head, costs)
    heads = _aux_heads(head)
    if heads is not None:
        settings[HEAD + "aux_heads"] = heads
    return settings


def _loss_settings(head: Fields, costs: Fields) -> dict[str, Any]:
    """Return the settings of matched losses and costs, and the head that has them."""
    pts = head.section("loss_pts").take("loss_weight")
    direction = head.section("loss_dir").take("loss_weight")
    pts_cost = costs.section("pts_cost").take("weight")
    cls_cost = costs.section("cls_cost").take("weight")
    for section in (head.section("loss_pts"), head.section("loss_dir")):
        section.drop("type")
    for name in ("pts_cost", "cls_cost"):
        costs.section(name).drop("type")
    settings: dict[str, Any] = {
        HEAD + "match_costs.0.weight": cls_cost,
        HEAD + "match_costs.1.weight": pts_cost,
        HEAD + "losses.0.loss_weight": pts,
        HEAD + "losses.1.loss_weight": direction,
    }
    dice, dice_cost = head.section("loss_rendered_mask"), costs.section("rendered_mask_cost")
    if dice.take("type", None):
        dice_cost.drop("type")
        settings |= {
            HEAD + "type": "MapVRHead",
            HEAD + "points_weight": pts,
            HEAD + "loss_direction": {"type": "SelfDirectionLoss", "loss_weight": direction},
            HEAD + "loss_dice": {"loss_weight": dice.take("weight")},
            HEAD + "dice_cost": {"weight": dice_cost.take("weight")},
        }
        if pts != pts_cost:
            costs.rest["pts_cost"] = {"weight": pts_cost}
    euclidean = head.section("loss_geo")
    if head.take("use_geo_loss", False):
        head.drop("intra_loss_weight", "inter_loss_weight")
        euclidean.drop("type", "num_ins", "num_pts", "pc_range")
        euclidean.only(loss_type="l1")
        settings |= {
            HEAD + "type": "GeMapHead",
            HEAD + "loss_euclidean": {
                "loss_weight": euclidean.take("loss_weight"),
                "shape_weight": euclidean.take("intra_loss_weight", 1.0),
                "relation_weight": euclidean.take("inter_loss_weight", 1.0),
            },
        }
    return settings


def _aux_heads(head: Fields) -> list[dict[str, Any]] | None:
    """Return the configs of MapTRv2's auxiliary heads; None where there are none."""
    depth = head.section("transformer", "encoder").take("loss_depth_weight", None)
    masks = head.section("aux_seg")
    masks.only(seg_classes=1, use_aux_seg=True)
    masks.drop("feat_down_sample", "pv_thickness")
    heads: list[dict[str, Any]] = []
    for flag, kind, name in (
        ("bev_seg", "BEVMaskHead", "loss_seg"),
        ("pv_seg", "PVMaskHead", "loss_pv_seg"),
    ):
        loss = head.section(name)
        loss.drop("type")
        weights = {key: loss.take(key, None) for key in ("loss_weight", "pos_weight")}
        if masks.take(flag, False):
            heads.append({"type": kind, **weights})
    if depth:
        heads.append({"type": "DepthSupervision", "loss_weight": depth})
    return heads or None


def _margin(coder: Fields, ranges: Any) -> float | None:
    """Return how far beyond the map a detection may lie, if it is the same on all sides."""
    coder.drop("type", "pc_range", "voxel_size", "num_classes")
    limits = coder.rest.get("post_center_range", ())
    (x0, x1), (y0, y1) = ranges
    if len(limits) != 8:
        return None
    margins = {x0 - limits[0], y0 - limits[1], limits[4] - x1, limits[5] - y1}
    if len(margins) != 1 or limits[:2] != limits[2:4] or limits[4:6] != limits[6:]:
        return None
    coder.drop("post_center_range")
    return float(margins.pop())
