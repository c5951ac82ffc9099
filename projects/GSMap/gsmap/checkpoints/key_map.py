"""The tables between the state keys of the earlier systems and ours."""

from collections.abc import Iterable

import torch
from torch import Tensor

from gsmap.checkpoints.hdmapnet_keys import HDMAPNET, VIEWS
from gsmap.checkpoints.key_rules import KeyMap, rules_of, zeros
from gsmap.checkpoints.line_keys import BEMAPNET, LINE_DECODER, PIVOTNET
from gsmap.checkpoints.vectormapnet_keys import LINES, VECTORMAPNET

_HEAD = "pts_bbox_head."
_TRANSFORMER = "pts_bbox_head.transformer."
_ENCODER = "pts_bbox_head.transformer.encoder."
_ENCODER_LAYER = "pts_bbox_head.transformer.encoder.layers.{i}."
_DECODER = "pts_bbox_head.transformer.decoder."
_DECODER_LAYER = "pts_bbox_head.transformer.decoder.layers.{i}."
_OUR_ENCODER_LAYER = "bev_encoder.layers.{i}."
_LAYER = "map_head.decoder.layers.{i}."

_COMMON_RULES = (
    *rules_of("", "", "img_backbone. img_neck."),
    *rules_of(_HEAD, "map_head.", "instance_embedding. pts_embedding. cls_branches."),
    *rules_of(_HEAD, "map_head.reference.", "reg_branches.=branches."),
    *rules_of(_TRANSFORMER, "map_head.reference.", "reference_points.=initial."),
)
_DECODER_RULES = rules_of(
    _DECODER_LAYER,
    _LAYER,
    "attentions.0.attn.=self_attn. attentions.1.=cross_attn. ffns.0.=ffn. norms.",
)
_BEV_QUERY_RULES = (
    *_COMMON_RULES,
    *_DECODER_RULES,
    *rules_of(_HEAD, "bev_encoder.", "bev_embedding. positional_encoding."),
    *rules_of(_TRANSFORMER, "bev_encoder.", "level_embeds cams_embeds can_bus_mlp."),
    *rules_of(_ENCODER_LAYER, _OUR_ENCODER_LAYER, "attentions.0.=self_attn. ffns.0.=ffn. norms."),
    *rules_of(
        _ENCODER_LAYER, _OUR_ENCODER_LAYER, "attentions.1.output_proj.=cross_attn.output_proj."
    ),
)
_CODE_WEIGHTS = {_HEAD + "code_weights": torch.ones(4)}  # of box coordinates: a loss of weight 0

# the fixed offsets of the kernel, a buffer of the code that MapTR's weights were published with
_GRID_OFFSETS = (
    r"pts_bbox_head\.transformer\.encoder\.layers\.\d+\.attentions\.1\.attention\.grid_offsets"
)
_KERNELS = (_ENCODER_LAYER + "attentions.1.attention.", _OUR_ENCODER_LAYER + "cross_attn.")
_DEFORMABLE = _ENCODER_LAYER + "attentions.1.deformable_attention."
MAPTR = KeyMap("maptr", (*_BEV_QUERY_RULES, _KERNELS), _CODE_WEIGHTS, idle=_GRID_OFFSETS)
MAPTR_BEVFORMER = KeyMap(
    "maptr-bevformer",
    (*_BEV_QUERY_RULES, (_DEFORMABLE, _OUR_ENCODER_LAYER + "cross_attn.")),
    _CODE_WEIGHTS,
    markers=((_DEFORMABLE, _OUR_ENCODER_LAYER + "cross_attn.sampling_offsets."),),
)

_MASK_RULES = rules_of(_HEAD, "map_head.aux_heads.", "seg_head.=seg. pv_seg_head.=pv_seg.")
# the weight of the foreground in a mask loss, which the config says
_MASK_WEIGHTS = {
    _HEAD + "loss_seg.loss_fn.pos_weight": torch.tensor((4.0,)),
    _HEAD + "loss_pv_seg.loss_fn.pos_weight": torch.tensor((1.0,)),
}
_HEIGHTS = (
    _ENCODER_LAYER + "attentions.1.height_offsets.",
    _OUR_ENCODER_LAYER + "cross_attn.height_offsets.",
)
MAPQR = KeyMap(
    "mapqr",
    (
        _HEIGHTS,
        *MAPTR.rules,
        *_MASK_RULES,
        (_DECODER + "pt_pos_query_projs.{i}.", _LAYER + "position_proj."),
    ),
    {**_CODE_WEIGHTS, **_MASK_WEIGHTS},
    markers=(_HEIGHTS,),
    idle=_GRID_OFFSETS,
)

_ENHANCED = _TRANSFORMER + "bevencode."
_NECK = "map_head.decoder.neck."
_BLOCKS = tuple((f"{_ENHANCED}layer{n + 1}.{{i}}.", f"{_NECK}stages.{n}.{{i}}.") for n in range(3))
_ACTIVATION = (_TRANSFORMER + "decoder.ins_conv.", "map_head.decoder.mask_net.")
MGMAP = KeyMap(
    "mgmap",
    (
        _ACTIVATION,
        (_TRANSFORMER + "decoder.linear1.", "map_head.decoder.activation."),
        (_HEAD + "pts_embedding_.", "map_head.pts_embedding."),
        *rules_of(
            _ENHANCED,
            _NECK,
            "conv1.=stem.0. bn1.=stem.1. conv_1.conv.=fusion.0. conv_1.bn.=fusion.1. "
            "neck.convs.{i}.conv.=levels.{i}.0. neck.convs.{i}.norm.=levels.{i}.1.",
        ),
        *(
            rule
            for block in _BLOCKS
            for rule in rules_of(*block, "ca.fc.=gates.channel. sa.conv1.=gates.space.")
        ),
        *_BLOCKS,
        *rules_of(
            _HEAD,
            "map_head.decoder.",
            "conv_2.conv.=segmentation.0. conv_2.bn.=segmentation.1. "
            "semantic_output.=segmentation.3. change_channels.conv_expand.=mask_feature.expand. "
            "change_channels.conv_basicblock.=mask_feature.block. "
            "process_net.conv_reduce.=mask_feature.reduce. ",
        ),
        *rules_of(
            _HEAD,
            "map_head.decoder.refinements.{i}.",
            "rcnn_net_{i}.=patch_net. rego_hs_linear_{i}.=memory.0. "
            "rego_hs_linear_norm_{i}.=memory.1. glimpse_transformer_{i}.decoder.layers.0.=layer. "
            "glimpse_transformer_{i}.decoder.norm.=norm. rego_hs_fuser_{i}.0.=fuser.0. "
            "layer_norms_{i}.0.=fuser.1.",
        ),
        *MAPTR.rules,
    ),
    _CODE_WEIGHTS,
    markers=(_ACTIVATION,),
    # never called, but for a second name of glimpse_transformer_0 and weights in a loss
    idle=r"pts_bbox_head\.(conv_seg|glimpse_transformer|loss_fn_?|(cls|reg)_branches\.[6-9]|"
    r"transformer\.bevencode\.(fpn_conv|attention)|(rego_hs_fuser|layer_norms)_\d\.[1-5])\.|"
    + _GRID_OFFSETS,
)

_LIFTED_RULES = (
    *_COMMON_RULES,
    *_MASK_RULES,
    *rules_of(_ENCODER, "bev_encoder.", "depth_net. downsample."),
)
_LIFTED_UNUSED: dict[str, Tensor | None] = {
    **_CODE_WEIGHTS,
    # parts of the encoder with learned BEV queries, which depth lifting does not run
    **zeros(
        _HEAD,
        {
            "positional_encoding.row_embed.weight": (200, 128),
            "positional_encoding.col_embed.weight": (100, 128),
            "transformer.level_embeds": (4, 256),
            "transformer.cams_embeds": (6, 256),
            "transformer.can_bus_mlp.0.weight": (128, 18),
            "transformer.can_bus_mlp.0.bias": (128,),
            "transformer.can_bus_mlp.2.weight": (256, 128),
            "transformer.can_bus_mlp.2.bias": (256,),
            "transformer.can_bus_mlp.norm.weight": (256,),
            "transformer.can_bus_mlp.norm.bias": (256,),
        },
    ),
    # the grid of voxels, which the config says: size, first centre and number (x, y, z)
    _ENCODER + "dx": torch.tensor((0.15, 0.15, 20.0)),
    _ENCODER + "bx": torch.tensor((-14.925, -29.925, 0.0)),
    _ENCODER + "nx": torch.tensor((200.0, 400.0, 1.0)),
    **_MASK_WEIGHTS,
}
_LIFTED_MARKER = (_ENCODER + "depth_net.", "bev_encoder.depth_net.depth_conv.")

MAPTRV2 = KeyMap(
    "maptrv2",
    (
        *_LIFTED_RULES,
        *rules_of(
            _DECODER_LAYER,
            _LAYER,
            "attentions.0.attn.=self_attn.instance_attn. attentions.1.attn.=self_attn.point_attn. "
            "attentions.2.=cross_attn. ffns.0.=ffn. "
            "norms.0.=self_attn.norm. norms.1.=norms.0. norms.2.=norms.1. norms.3.=norms.2.",
        ),
    ),
    _LIFTED_UNUSED,
    markers=(_LIFTED_MARKER,),
)

# The names are those of upstream since 2023-12-12. Before, upstream called the attention among
# instances "intra" and the one within each "inter", and no key tells the two apart.
_GEOMETRY_RULES = rules_of(
    _DECODER_LAYER + "attentions.0.", _LAYER + "self_attn.", "inter_=inter. intra_=intra."
)
GEMAP = KeyMap(
    "gemap",
    (*_GEOMETRY_RULES, *MAPTR.rules),
    {
        **_CODE_WEIGHTS,
        # On Argoverse 2, the simple objective is the full one's head with its parts switched off.
        _HEAD + "tau": None,  # a number that no computation reads
        _HEAD + "loss_seg.loss_fn.pos_weight": None,
        _HEAD + "loss_pv_seg.loss_fn.pos_weight": None,
    },
    markers=_GEOMETRY_RULES[:1],
    idle=_GRID_OFFSETS,
)
GEMAP_FULL = KeyMap(
    "gemap-full",
    (*_GEOMETRY_RULES, *_LIFTED_RULES, *_DECODER_RULES),
    {**_LIFTED_UNUSED, _HEAD + "tau": torch.full((1,), 0.1)},
    markers=(*_GEOMETRY_RULES[:1], _LIFTED_MARKER),
)

_INTERACTION = (
    "cross_attn.=attn. linear1.=ffn.layers.0.0. linear2.=ffn.layers.1. norm1.=norms.0. "
    "norm3.=norms.1."
)
_DOWN_SAMPLING = (_TRANSFORMER + "bev_downsample.", "map_head.decoder.bev_pyramid.merges.0.")
_IDLE = "attentions.1.output_proj_instance"
_NORM = ("weight", "bias", "running_mean", "running_var")
MGMAPNET = KeyMap(
    "mgmapnet",
    (
        *_LIFTED_RULES,
        (_HEAD + "ins_seg_head.", "map_head.losses.ins_seg.embedding."),
        _DOWN_SAMPLING,
        *rules_of(
            _DECODER_LAYER + "attentions.1.p2p_attention.", _LAYER + "cross_attn.p2p.", _INTERACTION
        ),
        *rules_of(
            _DECODER_LAYER + "attentions.1.p2i_attention.", _LAYER + "cross_attn.p2i.", _INTERACTION
        ),
        *rules_of(
            _DECODER_LAYER + "attentions.1.",
            _LAYER + "cross_attn.",
            "point_pos.=point_code. instance_pos.=instance_code. output_proj_point.=output_proj. "
            "point2ins_proj.=instance_mlp.",
        ),
        *_DECODER_RULES,
        *rules_of(
            _DECODER,
            _LAYER,
            "point_ffn.{i}.=point_ffn. point_norm.{i}.=point_norm. "
            "gen_pos_embed.{i}.=reference_code.",
        ),
    ),
    {
        **_LIFTED_UNUSED,
        _HEAD + "loss_seg.loss_fn.pos_weight": None,  # a loss that MGMapNet has not
        **zeros(
            _HEAD,
            {
                # the embedding of the points, which MGMapNet's queries do not use
                "pts_embedding.weight": (20, 512),
                # the second mask head of the camera view, which is never called
                **{f"bev_pv_seg_head.{i}.weight": (256, 256, 3, 3) for i in (0, 3)},
                **{f"bev_pv_seg_head.{i}.{leaf}": (256,) for i in (1, 4) for leaf in _NORM},
                **{f"bev_pv_seg_head.{i}.num_batches_tracked": () for i in (1, 4)},
                "bev_pv_seg_head.6.weight": (3, 256, 1, 1),
                "bev_pv_seg_head.6.bias": (3,),
            },
        ),
        **zeros(
            _DECODER,
            {
                # the code of the first layer's reference, which adds the learned position instead
                "gen_pos_embed.0.0.weight": (256, 40),
                "gen_pos_embed.0.0.bias": (256,),
                "gen_pos_embed.0.2.weight": (256, 256),
                "gen_pos_embed.0.2.bias": (256,),
                # the projection of the aggregated instance query, which is never called
                **{f"layers.{i}.{_IDLE}.weight": (256, 256) for i in range(6)},
                **{f"layers.{i}.{_IDLE}.bias": (256,) for i in range(6)},
            },
        ),
    },
    markers=(_DOWN_SAMPLING,),
)

_BACKBONE = "backbone."
_STREAM_INPUT = "head.input_proj."
_STREAM_ENCODER = "backbone.transformer.encoder.layers.{i}."
_STREAM_DECODER = "head.transformer.decoder.layers.{i}."
_Y, _X = torch.meshgrid(
    torch.linspace(15.0, -15.0, 50), torch.linspace(-30.0, 30.0, 100), indexing="ij"
)
STREAMMAPNET = KeyMap(
    "streammapnet",
    (
        *rules_of(_BACKBONE, "", "img_backbone. img_neck."),
        *rules_of(_BACKBONE, "bev_encoder.", "bev_embedding. positional_encoding."),
        *rules_of(_BACKBONE + "transformer.", "bev_encoder.", "level_embeds cams_embeds"),
        *rules_of(
            _STREAM_ENCODER,
            _OUR_ENCODER_LAYER,
            "attentions.0.=self_attn. attentions.1.output_proj.=cross_attn.output_proj. "
            "attentions.1.deformable_attention.=cross_attn. ffns.0.=ffn. norms.",
        ),
        *rules_of("head.", "map_head.", "query_embedding.=instance_embedding. cls_branches."),
        *rules_of("head.", "map_head.reference.", "reference_points_embed.=initial."),
        *rules_of("head.", "map_head.reference.", "reg_branches.=branches."),
        (_STREAM_INPUT, "map_head.decoder.input_proj."),
        *rules_of(
            _STREAM_DECODER,
            _LAYER,
            "attentions.0.attn.=self_attn. attentions.1.=cross_attn. ffns.0.=ffn. norms.",
        ),
        ("head.query_update.fc.", "temporal.queries.fc."),
        ("stream_fusion_neck.", "temporal.bev."),
    ),
    {  # the map's cells, size and corner, which the config says
        "plane": torch.stack([_X, _Y, torch.zeros_like(_X), torch.ones_like(_X)], -1),
        "head.roi_size": torch.tensor((60.0, 30.0)),
        "head.origin": torch.tensor((-30.0, -15.0)),
    },
    markers=((_STREAM_INPUT, "map_head.decoder.input_proj."),),
)

KEY_MAPS: list[KeyMap] = [
    HDMAPNET, VECTORMAPNET, STREAMMAPNET, BEMAPNET, PIVOTNET, MGMAPNET, GEMAP_FULL, GEMAP, MAPQR,
    MGMAP,
    MAPTRV2, MAPTR_BEVFORMER, MAPTR,
]  # fmt: skip
"""Known architectures, the most special first; the last needs no marker."""


def is_upstream(keys: Iterable[str]) -> bool:
    """Return whether state keys are in the format of the earlier systems."""
    return any(key.startswith((_HEAD, LINE_DECODER, _STREAM_INPUT, LINES, VIEWS)) for key in keys)


def find_key_map(keys: Iterable[str]) -> KeyMap:
    """Return the map of the architecture that state keys, upstream's or ours, belong to."""
    keys = list(keys)
    upstream = is_upstream(keys)
    for key_map in KEY_MAPS:
        if key_map.is_marked(keys, upstream):
            return key_map
    raise ValueError("the checkpoint holds no weights.")
