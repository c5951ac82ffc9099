"""Conversion of configs of the original MapTR, and of methods built on its code, to our configs.

The original config becomes a `Fields` object. Converted settings are removed from it, and settings
that GSMap does not need are dropped. The settings that remain have no counterpart in GSMap and are
reported.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from pprint import pformat
from typing import Any

from mmengine.config import Config

from gsmap.methods import METHODS
from gsmap.utils.errors import InputError
from mapdata.upstream_configs.data import PARTS, data_settings, schedule_settings
from mapdata.upstream_configs.fields import Fields
from mapdata.upstream_configs.names import (
    BEV,
    COSTS,
    CROSS_ATTENTIONS,
    DECODER,
    ENCODER,
    FIXED_TYPES,
    FIXED_VALUES,
    HEAD,
    HEAD_DEFAULTS,
    IGNORED_NAMES,
    KINDS,
    LAYER,
    MODEL_NAMES,
    ORDER,
    PILLAR_NAMES,
    PREFIXED_TYPES,
    PTS_HEAD,
    SEGMENTATIONS,
    SELF_ATTENTIONS,
    SPATIAL,
    SPATIAL_ATTENTIONS,
    TRANSFORMER,
    WEIGHTS,
)

# Keys and types of values that may be written to a config, which is executed as Python.
_KEY = re.compile(r"[a-zA-Z][\w.-]*", re.ASCII)
_TYPE = re.compile(r"(mmdet\.)?\w+")  # name of a registered class, and no path of a module
# Top-level names that configure a run. Other names are variables of the file.
TOP_LEVEL_NAMES = (
    "_base_", "model", "data", "optimizer", "optimizer_config", "lr_config", "total_epochs",
    "runner", "evaluation", "fp16", "checkpoint_config", "log_config", "load_from",
    "resume_from", "custom_hooks", "momentum_config", "cudnn_benchmark", "find_unused_parameters",
)  # fmt: skip


@dataclass
class Conversion:
    """Result of converting an original config.

    Args:
        base: Path of the GSMap config to modify, relative to ``configs``.
        settings: Values by dotted name in GSMap. A number in a name is an index of a list.
        steps: Settings of the steps of the data pipelines, by part (``train``, ``val`` and
            ``test``) and type of the step; None removes it.
        unplaced: Settings without a counterpart in GSMap, each as ``name = value``.
    """

    base: str
    settings: dict[str, Any]
    steps: dict[str, dict[str, dict[str, Any] | None]]
    unplaced: list[str]


def convert_upstream(names: dict[str, Any]) -> Conversion:
    """Convert the assignments of an original config to settings of a GSMap config.

    Args:
        names: Values by top-level name, as `mapdata.upstream_configs.reader` reads them from the
            file. Modified in place.

    Raises:
        ValueError: If the model, one of its parts or the data set is not supported, or a required
            setting is missing. Malformed settings may raise other errors, such as `KeyError` and
            `TypeError`, which the caller has to catch.
    """
    fields = Fields({name: names[name] for name in TOP_LEVEL_NAMES if name in names})
    models = _entries("models")
    heads = [f"{model}Head" for model in models]
    _check_kind(fields, "model", kinds=models)
    _check_kind(fields, PTS_HEAD, kinds=heads)
    for section, kinds in KINDS.items():
        _check_kind(fields, section, kinds=kinds)
    model = fields.section("model")["type"]
    for name, default in HEAD_DEFAULTS.items():
        fields.section(PTS_HEAD).setdefault(name, default)
    settings = data_settings(fields)
    settings |= schedule_settings(fields)
    settings |= _image_settings(fields)
    grid = settings["grid"]
    sides = (*grid["x_range"], *grid["y_range"])  # smallest and largest x, then y
    encoder = _encoder_settings(fields, settings, sides=sides)
    # The functions below read settings that this call and `data_settings` have converted.
    settings |= fields.move(MODEL_NAMES)
    _decoder_settings(fields, settings)
    _head_settings(fields, settings)
    _margin_settings(fields, settings, sides=sides)
    for section, weight in WEIGHTS.items():
        values = fields.section(section)  # the dict in `fields`, not a copy
        if values.get(weight) == 0:
            values.clear()
    _drop_settings(fields, pc_range=settings.pop("pc_range"))
    # These two select the base config and are no settings of GSMap.
    data_set = settings.pop("data_set")
    has_depth = settings.pop("with_depth")
    base = _base_config(encoder, model=model, data_set=data_set, has_depth=has_depth)
    return Conversion(
        base=base,
        settings=settings,
        steps=settings.pop("steps"),
        unplaced=fields.left_over(),
    )


def _drop_settings(fields: Fields, pc_range: Sequence[float]) -> None:
    """Drop the types and settings that GSMap does not need or that have the supported value.

    Args:
        fields: Settings of the original config.
        pc_range: Range of the data in metres, which all parts must have.
    """
    for section in {**IGNORED_NAMES, **FIXED_VALUES}:  # sections of either mapping
        fixed_values = FIXED_VALUES.get(section, {})
        fields.drop(section, names=IGNORED_NAMES.get(section, ""), **fixed_values)
    for section in (f"{PTS_HEAD}.bbox_coder", f"{PTS_HEAD}.loss_geo", ENCODER, COSTS):
        fields.drop(section, pc_range=pc_range)
    for section, types in FIXED_TYPES.items():
        fields.drop_type(section, types)
    prefixes = _entries("prefixes")
    for section, name in PREFIXED_TYPES.items():
        fields.drop_type(section, [f"{prefix}{name}" for prefix in prefixes])


def _entries(key: str) -> list[Any]:
    """List the entries of all methods under a key of ``upstream`` in their ``paper.json``."""
    entries: list[Any] = []
    for method in METHODS:
        entries += method.paper().get("upstream", {}).get(key, [])
    return entries


def _check_kind(fields: Fields, section: str, kinds: Sequence[str]) -> None:
    """Raise a ``ValueError`` if the type of a part is not one of ``kinds``."""
    kind = fields.section(section).get("type")
    if kind not in kinds:
        supported = ", ".join(kinds)
        raise InputError(
            f"{kind!s:.60} is not supported: {section}.type must be one of {supported}."
        )


def merge(conversion: Conversion, configs: Path) -> Config:
    """Merge the settings of a conversion into its base config.

    Args:
        conversion: Result of `convert_upstream`.
        configs: Folder of the GSMap configs.
    """
    values = Config.fromfile(configs / conversion.base, import_custom_modules=False).to_dict()
    # The sections on the way to a setting are looked up, and missing ones are created.
    for name, value in conversion.settings.items():
        *sections, key = name.split(".")
        section: Any = values
        for section_key in sections:
            if isinstance(section, list):
                section = section[int(section_key)]
            else:
                section = section.setdefault(section_key, {})
        # An empty list only replaces a list of the base config.
        if value != [] or key in section:
            section[key] = value
    cfg = Config(values)
    for part in PARTS:
        dataset = cfg[f"{part}_dataloader"].dataset
        pipeline = []
        for step in dataset.pipeline:
            changes = conversion.steps[part].get(step.type, {})
            if changes is not None:
                pipeline.append({**step, **changes})
        dataset.pipeline = pipeline
    return cfg


def python_text(cfg: Config) -> str:
    """Format a config as Python source, each value by its ``repr``.

    The text is a config file, which mmengine executes. Values that come from an untrusted file must
    therefore be plain numbers, texts and containers.

    Names with a leading underscore, such as ``_base_``, are left out.

    Args:
        cfg: Config.

    Raises:
        ValueError: If a value is neither a finite number nor a text, a key is not a plain word, a
            type is the path of a module, or a text has a placeholder of mmengine (``{{...}}``).
    """
    values = {}
    for name, value in cfg.to_dict().items():
        if not name.startswith("_"):
            values[name] = value
    _check_plain(values, name="")
    assignments = []
    for name, value in values.items():
        text = pformat(value, width=100, sort_dicts=False)
        assignments.append(f"{name} = {text}\n")
    return "".join(assignments)


def _check_plain(value: Any, name: str) -> None:
    """Raise a ``ValueError`` for values that are not safe in a config, which is code.

    Args:
        value: Dict, list, tuple or leaf.
        name: Dotted name of the value; empty for the config.
    """
    if isinstance(value, dict):
        for key, inner in value.items():
            inner_name = f"{name}.{key}".lstrip(".")
            if not isinstance(key, str) or not _KEY.fullmatch(key):
                raise InputError(f"{inner_name[:60]!r} is no name of a setting")
            if key == "type":
                _check_type(inner, name=inner_name)
            _check_plain(inner, name=inner_name)
    elif isinstance(value, (list, tuple)):
        for index, inner in enumerate(value):
            _check_plain(inner, name=f"{name}.{index}".lstrip("."))
    else:
        _check_leaf(value, name=name)


def _check_leaf(value: Any, name: str) -> None:
    """Raise a ``ValueError`` if a value is not None, a finite number or a text.

    A text must not have a placeholder of mmengine.
    """
    if isinstance(value, str):
        if "{{" in value:
            raise InputError(f"{name} is {value!r:.60}, which mmengine would replace")
    elif value is not None:
        is_number = isinstance(value, (int, float)) and math.isfinite(value)
        if not is_number:
            raise InputError(f"{name} is {value!r:.60}, neither a finite number nor a text")


def _check_type(value: Any, name: str) -> None:
    """Raise a ``ValueError`` if the type of a part is not the name of a registered class."""
    if not isinstance(value, str) or not _TYPE.fullmatch(value):
        raise InputError(f"{name} must be the name of a registered class, got {value!r:.60}")


def _base_config(encoder: str, model: str, data_set: str, has_depth: bool) -> str:
    """Select the GSMap config with this BEV encoder and data set.

    Args:
        encoder: Type of the BEV encoder, as `_encoder_settings` returns it.
        model: Type of the original detector, for the error message.
        data_set: ``nuScenes`` or ``Argoverse 2``.
        has_depth: Whether the samples have depth maps.

    Returns:
        Path relative to the folder of the configs.

    Raises:
        ValueError: If no config has this encoder on this data set.
    """
    for entry in _entries("configs"):
        has_encoder = entry["encoder"] == encoder and entry["data_set"] == data_set
        fits_depth = entry.get("depth", has_depth) == has_depth  # without "depth", both fit
        if has_encoder and fits_depth:
            config: str = entry["config"]
            return config.removeprefix("configs/")
    # `PlainLSSTransform` is a name of this file. The message has the name of the original encoder.
    raise InputError(f"{encoder.removeprefix('Plain')} of {model} is not supported on {data_set}.")


def _image_settings(fields: Fields) -> dict[str, Any]:
    """Convert the settings of backbone and neck to settings by dotted name in GSMap."""
    settings: dict[str, Any] = {}
    # The base configs augment images with GridMask in training. None switches this off.
    if not fields.take("model.use_grid_mask", default=False):
        settings["model.img_augment"] = None
    # A part replaces the part of the base config, whose settings may not fit its type.
    for part in ("img_backbone", "img_neck"):
        values = fields.take(f"model.{part}", default={})
        for name in values:
            if not str(name).isidentifier():
                raise InputError(f"model.{part} has {name!s:.60}, which is no name of a setting")
        if values["type"] == "VoVNet":
            values = _vovnet_settings(values)  # GSMap registers it itself
        else:
            values["type"] = f"mmdet.{values['type']}"
        settings[f"model.{part}"] = values
    checkpoint = (fields.take("model.pretrained", default=None) or {}).get("img")
    if checkpoint is not None:
        weights = {"type": "Pretrained", "checkpoint": checkpoint}
        settings["model.img_backbone"]["init_cfg"] = weights
    return settings


# Output index of each stage of VoVNet. The original counts the stem as stage 1.
_VOVNET_STAGES = {"stage2": 0, "stage3": 1, "stage4": 2, "stage5": 3}


def _vovnet_settings(values: dict[str, Any]) -> dict[str, Any]:
    """Convert the settings of the original VoVNet, such as ``spec_name="V-99-eSE"``.

    Raises:
        ValueError: If the network is of another kind.
    """
    if "spec_name" not in values:  # settings of GSMap's VoVNet
        return values
    spec_name = str(values.pop("spec_name"))
    stages = values.pop("out_features", ())
    size = re.fullmatch(r"V-(\d\d)-eSE", spec_name)
    if not size or not set(stages) <= _VOVNET_STAGES.keys():
        raise InputError(
            f"model.img_backbone of {spec_name:.60} with out_features {stages!s:.60} is not "
            "supported: spec_name must be V-19-eSE, V-39-eSE, V-57-eSE or V-99-eSE, and "
            f"out_features some of {', '.join(_VOVNET_STAGES)}."
        )
    values.pop("input_ch", None)  # always 3
    out_indices = tuple(_VOVNET_STAGES[stage] for stage in stages)
    return {**values, "depth": int(size[1]), "out_indices": out_indices}


def _encoder_settings(fields: Fields, settings: dict[str, Any], sides: tuple[float, ...]) -> str:
    """Convert the settings of the BEV encoder.

    Args:
        fields: Settings of the original config.
        settings: Converted settings, to which the settings of the encoder are added.
        sides: Smallest and largest x, then y, of the map in metres.

    Returns:
        Type of the encoder or of its spatial attention; ``PlainLSSTransform`` for a depth network
        without camera parameters.
    """
    kind: str = fields.take(f"{ENCODER}.type")
    embed_dims = fields.take(f"{TRANSFORMER}.embed_dims", default=256)
    settings[BEV + "embed_dims"] = embed_dims
    settings[HEAD + "embed_dims"] = embed_dims
    rows = fields.take(f"{PTS_HEAD}.bev_h")
    columns = fields.take(f"{PTS_HEAD}.bev_w")
    x_min, x_max, y_min, y_max = sides
    pixel_x_m = (x_max - x_min) / columns
    pixel_y_m = (y_max - y_min) / rows
    is_square = abs(pixel_x_m - pixel_y_m) < 1e-6
    settings[BEV + "z_range"] = tuple(settings.pop("z_range"))  # from `data_settings`
    settings[BEV + "bev_pixel_m"] = pixel_x_m if is_square else [pixel_x_m, pixel_y_m]
    if kind == "LSSTransform":
        fields.drop(ENCODER, names="out_channels feat_down_sample", downsample=2)
        fields.drop(TRANSFORMER, names="num_cams")  # depth lifting has no embeddings of cameras
        _drop_voxels(fields, settings=settings, pixel_m=(pixel_x_m, pixel_y_m))
        encoder = fields.section(ENCODER)
        # The depth network reads camera parameters if it has settings or a loss of depths. Without
        # them, MapTR's encoder is a plain one.
        reads_cameras = "depthnet_cfg" in encoder or "loss_depth_weight" in encoder
        if fields.section("model").get("type") == "MapTR" and not reads_cameras:
            kind = "PlainLSSTransform"
        aspp_channels = fields.take(f"{ENCODER}.depthnet_cfg.aspp_mid_channels", default=96)
        depth_range = fields.take(f"{ENCODER}.dbound")
        fields.drop(f"{ENCODER}.grid_config", names="x y z", depth=depth_range)
        settings[BEV + "depth_range"] = tuple(depth_range)
        settings[BEV + "aspp_channels"] = aspp_channels
        return kind
    fields.drop(ENCODER, num_points_in_pillar=4)
    settings[BEV + "with_can_bus"] = fields.take(f"{TRANSFORMER}.use_can_bus", default=True)
    settings[BEV + "num_cams"] = fields.take(f"{TRANSFORMER}.num_cams", default=6)
    settings |= fields.move(PILLAR_NAMES)
    _check_kind(fields, SPATIAL, kinds=SPATIAL_ATTENTIONS)
    kind = fields.take(f"{SPATIAL}.type")
    attention = BEV + "cross_attn."
    if kind == "GeometrySptialCrossAttention":
        kernel_size = fields.take(f"{SPATIAL}.attention.kernel_size")
        settings[attention + "num_heads"] = fields.take(f"{SPATIAL}.attention.num_heads")
        settings[attention + "kernel_size"] = tuple(kernel_size)
    else:
        num_points = fields.take(f"{SPATIAL}.deformable_attention.num_points", default=8)
        settings[attention + "num_points"] = num_points
    return kind


def _drop_voxels(fields: Fields, settings: dict[str, Any], pixel_m: tuple[float, float]) -> None:
    """Drop the size of the voxels of a depth network if it is the one that GSMap has.

    Args:
        fields: Settings of the original config.
        settings: Converted settings, with the range of the heights.
        pixel_m: Size of a BEV pixel in metres along x and y. Two voxels become one pixel.
    """
    voxel_size = fields.section(ENCODER).get("voxel_size", ())
    z_min, z_max = settings[BEV + "z_range"]
    expected = (pixel_m[0] / 2, pixel_m[1] / 2, z_max - z_min)
    if len(voxel_size) == 3:
        differences = [abs(a - b) for a, b in zip(voxel_size, expected, strict=True)]
        if max(differences) < 1e-6:
            fields.drop(ENCODER, names="voxel_size")


def _decoder_settings(fields: Fields, settings: dict[str, Any]) -> None:
    """Convert the settings of the decoder's attentions and add them to ``settings``."""
    layer = DECODER + "layer."
    layer_kind = fields.take(f"{LAYER}.type")
    # Dotted names of the attentions. A decoupled layer has a second self-attention with the
    # settings of the first.
    self_attention, *other_attentions, cross_attention = fields.items(f"{LAYER}.attn_cfgs")
    _check_kind(fields, self_attention, kinds=SELF_ATTENTIONS)
    _check_kind(fields, cross_attention, kinds=CROSS_ATTENTIONS)
    kind = fields.take(f"{self_attention}.type")
    num_heads = fields.take(f"{self_attention}.num_heads")
    settings[layer + "num_heads"] = num_heads
    # Types of the self-attention in GSMap. `GeometryDecoupledAttention` keeps its name.
    if layer_kind == "DecoupledDetrTransformerDecoderLayer":
        kind = "DecoupledSelfAttention"
    elif kind == "MultiheadAttention":
        kind = "PointSelfAttention"
    settings[layer + "self_attn.type"] = kind
    num_queries = fields.section(PTS_HEAD).get("num_vec")
    num_points = settings[HEAD + "num_points"]
    fields.drop(self_attention, names="embed_dims", num_ins=num_queries, num_pts=num_points)
    fields.drop(LAYER, operation_order=("self_attn", "norm") * len(other_attentions) + ORDER)
    dropout = fields.section(self_attention).get("dropout")
    for attention in other_attentions:
        fields.drop_type(attention, ("MultiheadAttention",))
        fields.drop(attention, names="embed_dims", num_heads=num_heads, dropout=dropout)
    fields.drop(cross_attention, names="type embed_dims num_levels im2col_step")
    # The original attentions have different default dropouts. In GSMap, the default is the dropout
    # of the layer.
    self_dropout = fields.take(f"{self_attention}.dropout", default=0.0)
    cross_dropout = fields.take(f"{cross_attention}.dropout", default=0.1)
    if self_dropout != settings[layer + "dropout"]:
        settings[layer + "self_attn.dropout"] = self_dropout
    if cross_dropout != settings[layer + "dropout"]:
        settings[layer + "cross_attn.dropout"] = cross_dropout


def _head_settings(fields: Fields, settings: dict[str, Any]) -> None:
    """Convert the settings of queries and losses and add them, with the head, to ``settings``."""
    num_classes = len(settings["classes"])
    num_points = settings[HEAD + "num_points"]
    fields.drop(PTS_HEAD, num_classes=num_classes, num_pts_per_gt_vec=num_points)
    fields.drop(f"{PTS_HEAD}.bbox_coder", num_classes=num_classes)
    loss_cls = settings[HEAD + "loss_cls"]
    loss_cls["type"] = f"mmdet.{loss_cls['type']}"

    def take(name: str, default: Any) -> Any:
        return fields.take(f"{PTS_HEAD}.{name}", default=default)

    # MapTR has `num_vec`. MapTRv2 has `num_vec_one2one`, and groups for one-to-many matching.
    num_queries = take("num_vec_one2one", default=None) or fields.take(f"{PTS_HEAD}.num_vec")
    one2many = {
        "name": "one2many",
        "num": take("num_vec_one2many", default=0),
        "repeats": take("k_one2many", default=0),
        "weight": take("lambda_one2many", default=1.0),
    }
    query_groups = [{"num": num_queries}]
    if one2many["num"]:
        if not one2many["repeats"]:
            raise InputError(f"{PTS_HEAD}.k_one2many is missing.")
        query_groups.append(one2many)
    settings[HEAD + "query_groups"] = query_groups
    _rendered_mask_settings(fields, settings)
    _geometric_loss_settings(fields, settings)
    _auxiliary_settings(fields, settings)


def _geometric_loss_settings(fields: Fields, settings: dict[str, Any]) -> None:
    """Convert the settings of the Euclidean loss (GeMap) and add them, if it is on."""
    loss = f"{PTS_HEAD}.loss_geo"
    fields.drop(PTS_HEAD, names="intra_loss_weight inter_loss_weight")
    if not fields.take(f"{PTS_HEAD}.use_geo_loss", default=False):
        fields.section(loss).clear()  # it has no effect
        return
    num_queries = settings[HEAD + "query_groups"][0]["num"]
    num_points = settings[HEAD + "num_points"]
    fields.drop_type(loss, ("GeometricLoss",))
    fields.drop(loss, num_ins=num_queries, num_pts=num_points, loss_type="l1")
    settings[HEAD + "type"] = "GeMapHead"
    settings[HEAD + "loss_euclidean"] = {
        "loss_weight": fields.take(f"{loss}.loss_weight"),
        "shape_weight": fields.take(f"{loss}.intra_loss_weight", default=1.0),
        "relation_weight": fields.take(f"{loss}.inter_loss_weight", default=1.0),
    }


def _auxiliary_settings(fields: Fields, settings: dict[str, Any]) -> None:
    """Convert the settings of segmentation and depth. Other auxiliary heads are removed."""
    aux_heads: list[dict[str, Any]] = []
    steps = settings["steps"]["train"]
    aux_seg = f"{PTS_HEAD}.aux_seg"
    is_on = fields.take(f"{aux_seg}.use_aux_seg", default=False)
    # Settings of the masks of the camera views.
    mask_names = {
        f"{aux_seg}.feat_down_sample": "stride",
        f"{aux_seg}.pv_thickness": "thickness_px",
    }
    steps["MakePVMask"] |= fields.move(mask_names, required=False)
    for flag, loss, head, step in SEGMENTATIONS:
        section = f"{PTS_HEAD}.{loss}"
        if not fields.take(f"{aux_seg}.{flag}", default=False) or not is_on:
            fields.section(section).clear()  # it has no effect
            steps[step] = None
            continue
        fields.drop_type(section, ("SimpleLoss",))
        mask_head = {
            "type": head,
            "loss_weight": fields.take(f"{section}.loss_weight", default=1.0),
            "pos_weight": fields.take(f"{section}.pos_weight", default=2.13),
        }
        aux_heads.append(mask_head)
    # Without depth maps, the original has no loss of depths either.
    depth_weight = fields.take(f"{ENCODER}.loss_depth_weight", default=None)
    if depth_weight and settings["with_depth"]:
        aux_heads.append({"type": "DepthSupervision", "loss_weight": depth_weight})
    else:
        steps["MakeDepthMap"] = None
    settings[HEAD + "aux_heads"] = aux_heads


def _rendered_mask_settings(fields: Fields, settings: dict[str, Any]) -> None:
    """Convert the settings of the losses and costs of rendered masks (MapVR), if there are any.

    Args:
        fields: Settings of the original config.
        settings: Converted settings. The weights of the points and the directions are read, and the
            settings of MapVR's head are added.
    """
    if not fields.section(f"{PTS_HEAD}.loss_rendered_mask"):
        return
    points_weight = settings[f"{HEAD}losses.0.loss_weight"]
    direction_weight = settings[f"{HEAD}losses.1.loss_weight"]
    fields.drop_type(f"{PTS_HEAD}.loss_rendered_mask", ("RenderedMaskDiceLoss",))
    fields.drop_type(f"{COSTS}.rendered_mask_cost", ("RenderedMaskDiceCost",))
    dice_weight = fields.take(f"{PTS_HEAD}.loss_rendered_mask.weight")
    dice_cost_weight = fields.take(f"{COSTS}.rendered_mask_cost.weight")
    settings[HEAD + "type"] = "MapVRHead"
    settings[HEAD + "points_weight"] = points_weight
    settings[HEAD + "loss_direction"] = {
        "type": "SelfDirectionLoss",
        "loss_weight": direction_weight,
    }
    settings[HEAD + "loss_dice"] = {"loss_weight": dice_weight}
    settings[HEAD + "dice_cost"] = {"weight": dice_cost_weight}
    cost_weight = settings[HEAD + "match_costs.1.weight"]
    if points_weight != cost_weight:
        # GSMap has one weight for both loss and cost. A different cost weight is put back into the
        # section, so that it is reported as unplaced.
        fields.section(f"{COSTS}.pts_cost")["weight"] = cost_weight


def _margin_settings(fields: Fields, settings: dict[str, Any], sides: tuple[float, ...]) -> None:
    """Convert the range of the predictions to a margin around the map.

    The range remains in ``fields`` if the margins of the four sides differ.

    Args:
        fields: Settings of the original config.
        settings: Converted settings, to which the margin is added.
        sides: Smallest and largest x, then y, of the map in metres.
    """
    # GSMap has one margin for all sides. In the original config, the box of a prediction has two
    # corners. `limits` are the smallest x and y of the first and of the second corner, then the
    # largest x and y of both.
    limits = fields.section(f"{PTS_HEAD}.bbox_coder").get("post_center_range", ())
    if len(limits) != 8:
        return
    x_min, x_max, y_min, y_max = sides
    margins = {x_min - limits[0], y_min - limits[1], limits[4] - x_max, limits[5] - y_max}
    have_corners_equal_limits = limits[:2] == limits[2:4] and limits[4:6] == limits[6:]
    if len(margins) == 1 and have_corners_equal_limits:
        fields.drop(f"{PTS_HEAD}.bbox_coder", names="post_center_range")
        settings[HEAD + "coder.margin_m"] = float(margins.pop())
