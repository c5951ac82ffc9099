"""The tables of BeMapNet and PivotNet, whose releases have one code in common."""

import torch

from gsmap.checkpoints.key_rules import KeyMap, Rules, rules_of

LINE_DECODER = "ins_decoder.bev_decoder."
"""What keys of both releases begin with, and of no other."""

_BEV = "bev_decoder.bev_encoder."
_NECK = "im_backbone.fpn.model."
_LINEAR = "linear1.=ffn.layers.0.0. linear2.=ffn.layers.1. "
_MLP = ((0, 0), (1, 2), (2, 4))  # matrices of an MLP, theirs and ours


def _mlps(theirs: str, ours: str) -> Rules:
    """Return the rules of an MLP."""
    return tuple((f"{theirs}layers.{old}.", f"{ours}{new}.") for old, new in _MLP)


_LINE_DECODER_RULES = (
    *rules_of(
        LINE_DECODER + "transformer_",
        "map_head.decoder.layers.{i}.",
        "cross_attention_layers.{i}.multihead_attn.=cross_attn. "
        "cross_attention_layers.{i}.norm.=norms.0. "
        "self_attention_layers.{i}.self_attn.=self_attn. "
        "self_attention_layers.{i}.norm.=norms.1. "
        "ffn_layers.{i}.linear1.=ffn.layers.0.0. ffn_layers.{i}.linear2.=ffn.layers.1. "
        "ffn_layers.{i}.norm.=norms.2.",
    ),
    *rules_of(
        LINE_DECODER,
        "map_head.decoder.",
        "level_embed.=level. decoder_norm.=norm.",
    ),
)
_HEAD_RULES = (
    *_mlps("output_head.coords_head.", "map_head.coordinates."),
    ("output_head.semantic_heads.{i}.0.", "map_head.semantic_branches.{i}."),
)
# settings: class weights of a loss
_CLASS_WEIGHTS = {"post_processor.criterion.empty_weight": torch.tensor((1.0, 0.5))}

PIVOTNET = KeyMap(
    "pivotnet",
    (
        ("im_backbone.bkb.", "img_backbone."),
        *rules_of(
            _BEV + "encoder.layers.{i}.",
            "bev_encoder.source_layers.{i}.",
            f"self_attn.=attns.0. norm1.=norms.0. {_LINEAR} norm2.=norms.1.",
        ),
        *rules_of(
            _BEV + "decoder.layers.{i}.",
            "bev_encoder.bev_layers.{i}.",
            f"self_attn.=attns.0. norm2.=norms.0. cross_attn.=attns.1. norm1.=norms.1. {_LINEAR} "
            "norm3.=norms.2.",
        ),
        *rules_of(
            _BEV,
            "bev_encoder.",
            "input_proj. t2s_reference_points.=unseen_reference. "
            "src_pos_embed.{i}.pos_embed.=source_pos.{i}. "
            "tgt_pos_embed.pos_embed.=bev_pos. tgt_embed.pos_embed.=bev_embedding.",
        ),
        *_LINE_DECODER_RULES,
        *rules_of(
            LINE_DECODER,
            "map_head.decoder.",
            "query_feat=query.weight query_embed=query_pos.weight class_embed.=cls_branches.",
        ),
        *_mlps(LINE_DECODER + "mask_embed.{i}.", "map_head.decoder.mask_branches.{i}."),
        *_mlps("output_head.im_ctr_heads.{i}.", "map_head.point_branches.{i}."),
        *_mlps("output_head.pts_cls_heads.{i}.", "map_head.kind_branches.{i}."),
        *_HEAD_RULES,
    ),
    {
        **_CLASS_WEIGHTS,
        # settings: where each camera stands in the joined image, class weights of another loss
        _BEV + "image_order": torch.arange(6),
        "post_processor.criterion.collinear_pt_weight": torch.tensor((0.2, 1.0)),
    },
    markers=((LINE_DECODER + "query_feat", "map_head.decoder.query.weight"),),
)

_CONVS = "depthwise_conv.conv.=depthwise. pointwise_conv.conv.=pointwise. bn.=norm."
_PROJECTIONS = {  # ours of theirs; in each, their convolution has one name more
    "p3_down_channel.": "inputs.0.",
    "p4_down_channel.": "inputs.1.",
    "p5_down_channel.": "inputs.2.",
    "p4_down_channel_2.": "again.0.",
    "p5_down_channel_2.": "again.1.",
    "p5_to_p6.": "coarser.",
}
_NECK_RULES = (
    *(
        rule
        for way, word, number, levels in (
            ("down", "up", 1, (6, 5, 4, 3)),
            ("up", "down", 2, (4, 5, 6, 7)),
        )
        for i, level in enumerate(levels)
        for rule in (
            *rules_of(
                f"{_NECK}{{i}}.conv{level}_{word}.", f"img_neck.rounds.{{i}}.{way}.{i}.", _CONVS
            ),
            (f"{_NECK}{{i}}.p{level}_w{number}", f"img_neck.rounds.{{i}}.{way}.{i}.weights"),
        )
    ),
    *(
        (f"{_NECK}0.{theirs}{part}", f"img_neck.{ours}{number}.")
        for theirs, ours in _PROJECTIONS.items()
        for part, number in (("0.conv.", 0), ("1.", 1))
    ),
)
BEMAPNET = KeyMap(
    "bemapnet",
    (
        ("im_backbone.bkb.", "img_backbone."),
        *_NECK_RULES,
        *rules_of(
            _BEV + "encoder.layers.{i}.",
            "bev_encoder.source_layers.{i}.",
            f"self_attn.=self_attn. norm1.=norms.0. {_LINEAR} norm2.=norms.1.",
        ),
        *rules_of(
            _BEV + "decoder.layers.{i}.",
            "bev_encoder.bev_layers.{i}.",
            f"self_attn.=self_attn. multihead_attn.=cross_attn. norm1.=norms.0. norm2.=norms.1. "
            f"norm3.=norms.2. {_LINEAR}",
        ),
        *rules_of(
            _BEV,
            "bev_encoder.",
            "input_proj. query_embed.=bev_embedding. decoder.norm.=norm. "
            "src_pos_embed_layer.encoder.=position.",
        ),
        *_LINE_DECODER_RULES,
        *rules_of(
            LINE_DECODER,
            "map_head.decoder.",
            "query_feat.=query. query_embed.=query_pos. class_embed.=cls_branches.0.",
        ),
        *_mlps(LINE_DECODER + "mask_embed.", "map_head.decoder.mask_branches.0."),
        *_mlps("output_head.im_ctr_heads.{i}.", "map_head.joint_branches.{i}."),
        *_mlps("output_head.ex_ctr_heads.{i}.", "map_head.inner_branches.{i}."),
        *_mlps("output_head.npiece_heads.{i}.", "map_head.piece_branches.{i}."),
        *_HEAD_RULES,
    ),
    _CLASS_WEIGHTS,
    markers=((_NECK, "img_neck.rounds."),),
    idle=r"bev_decoder\.bev_encoder\.tgt_pos_embed_layer\.",  # listed twice there, one module
)
