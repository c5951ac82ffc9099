"""Tables of the settings of an upstream model: names in GSMap, supported values, ignored names."""

from typing import Any

from mapdata.upstream_configs.data import FLAT

# sections of a GSMap config
HEAD = "model.map_head."
DECODER = HEAD + "decoder."
BEV = "model.bev_encoder."
# sections of an original config
PTS_HEAD = "model.pts_bbox_head"
TRAINING = "model.train_cfg.pts"
COSTS = f"{TRAINING}.assigner"
TRANSFORMER = f"{PTS_HEAD}.transformer"
ENCODER = f"{TRANSFORMER}.encoder"
PILLARS = f"{ENCODER}.transformerlayers"
SPATIAL = f"{PILLARS}.attn_cfgs.1"  # the second attention; the first one is temporal
LAYER = f"{TRANSFORMER}.decoder.transformerlayers"
# names in GSMap of settings of the model, by name in an original config
MODEL_NAMES = {
    f"{TRANSFORMER}.decoder.num_layers": DECODER + "num_layers",
    f"{LAYER}.feedforward_channels": DECODER + "layer.ffn_dims",
    f"{LAYER}.ffn_dropout": DECODER + "layer.dropout",
    f"{PTS_HEAD}.num_pts_per_vec": HEAD + "num_points",
    f"{PTS_HEAD}.bbox_coder.max_num": HEAD + "coder.max_num",
    f"{PTS_HEAD}.loss_cls": HEAD + "loss_cls",
    f"{PTS_HEAD}.loss_pts.loss_weight": HEAD + "losses.0.loss_weight",
    f"{PTS_HEAD}.loss_dir.loss_weight": HEAD + "losses.1.loss_weight",
    f"{COSTS}.cls_cost.weight": HEAD + "match_costs.0.weight",
    f"{COSTS}.pts_cost.weight": HEAD + "match_costs.1.weight",
}
# names in GSMap of settings of BEVFormer's encoder, by name in an original config
PILLAR_NAMES = {
    f"{ENCODER}.num_layers": BEV + "num_layers",
    f"{PILLARS}.feedforward_channels": BEV + "layer_cfg.ffn_dims",
    f"{PILLARS}.ffn_dropout": BEV + "layer_cfg.dropout",
}
# Supported types of the parts that select the parts of the GSMap config, by section. Another type
# is an error.
KINDS: dict[str, tuple[str, ...]] = {
    ENCODER: ("BEVFormerEncoder", "LSSTransform"),
    LAYER: ("DetrTransformerDecoderLayer", "DecoupledDetrTransformerDecoderLayer"),
}
SELF_ATTENTIONS = ("MultiheadAttention", "GeometryDecoupledAttention")
CROSS_ATTENTIONS = ("CustomMSDeformableAttention",)
SPATIAL_ATTENTIONS = ("GeometrySptialCrossAttention", "SpatialCrossAttention")
# Supported types of the other parts, by section. Another type remains, and is reported.
FIXED_TYPES: dict[str, tuple[str, ...]] = {
    f"{PTS_HEAD}.loss_pts": ("PtsL1Loss",),
    f"{PTS_HEAD}.loss_dir": ("PtsDirCosLoss",),
    f"{PTS_HEAD}.positional_encoding": ("LearnedPositionalEncoding",),
    f"{COSTS}.cls_cost": ("FocalLossCost",),
    f"{COSTS}.pts_cost": ("OrderedPtsL1Cost",),
    PILLARS: ("BEVFormerLayer",),
    f"{PILLARS}.attn_cfgs.0": ("TemporalSelfAttention",),
    f"{SPATIAL}.attention": ("GeometryKernelAttention",),
    f"{SPATIAL}.deformable_attention": ("MSDeformableAttention3D",),
}
# Parts that each code base names with its prefix, such as MapTRDecoder, by section: the supported
# type without the prefix. Another type remains, and is reported.
PREFIXED_TYPES = {
    TRANSFORMER: "PerceptionTransformer",
    f"{TRANSFORMER}.decoder": "Decoder",
    f"{PTS_HEAD}.bbox_coder": "NMSFreeCoder",
    COSTS: "Assigner",
}
ORDER = ("self_attn", "norm", "cross_attn", "norm", "ffn", "norm")  # steps of a layer
# Settings for which GSMap supports only one value, by section. They are dropped if they have it,
# and reported otherwise.
FIXED_VALUES: dict[str, dict[str, Any]] = {
    "model": {"video_test_mode": False},
    PTS_HEAD: {
        "query_embed_type": "instance_pts", "transform_method": "minmax",
        "gt_shift_pts_pattern": "v2", "with_box_refine": True, "as_two_stage": False,
        "sync_cls_avg_factor": True, "code_size": 2, "dir_interval": 1, "z_cfg": FLAT,
    },
    f"{PTS_HEAD}.aux_seg": {"seg_classes": 1},
    ENCODER: {"return_intermediate": False},
    f"{ENCODER}.depthnet_cfg": {"use_dcn": False, "with_cp": False},
    PILLARS: {"operation_order": ORDER},
    f"{SPATIAL}.attention": {"dilation": 1, "num_levels": 1},
    f"{SPATIAL}.deformable_attention": {"num_levels": 1},
    f"{TRANSFORMER}.decoder": {"return_intermediate": True},
    **{section: {"z_cfg": FLAT} for section in (f"{PTS_HEAD}.bbox_coder", TRANSFORMER, COSTS)},
}  # fmt: skip
# Defaults of the original head that GSMap does not support. A config without these settings has
# these values.
HEAD_DEFAULTS = {
    "query_embed_type": "all_pts",
    "gt_shift_pts_pattern": "v0",
    "with_box_refine": False,
}
# Names of the weights of parts, by section. A part whose weight is zero has no effect and is
# dropped.
WEIGHTS = {
    f"{PTS_HEAD}.loss_bbox": "loss_weight", f"{PTS_HEAD}.loss_iou": "loss_weight",
    f"{COSTS}.reg_cost": "weight", f"{COSTS}.iou_cost": "weight",
}  # fmt: skip
# settings that follow from other settings or have no effect in GSMap: names separated by spaces, by
# section
IGNORED_NAMES = {
    "model": "type",
    PTS_HEAD: "type num_query in_channels code_weights",
    f"{PTS_HEAD}.positional_encoding": "num_feats row_num_embed col_num_embed",
    f"{PTS_HEAD}.bbox_coder": "voxel_size",
    TRAINING: "grid_size voxel_size point_cloud_range out_size_factor",
    TRANSFORMER: "rotate_prev_bev use_shift use_can_bus",
    ENCODER: "in_channels",
    f"{PILLARS}.attn_cfgs.0": "embed_dims num_levels",
    SPATIAL: "embed_dims pc_range num_cams",
    f"{SPATIAL}.attention": "embed_dims im2col_step",
    f"{SPATIAL}.deformable_attention": "embed_dims im2col_step",
    LAYER: "num_vec num_pts_per_vec",
}
# Switches of the segmentations in the original head, their losses, and the auxiliary heads and the
# pipeline steps in GSMap.
SEGMENTATIONS = (
    ("bev_seg", "loss_seg", "BEVMaskHead", "MakeBEVMask"),
    ("pv_seg", "loss_pv_seg", "PVMaskHead", "MakePVMask"),
)
