"""The table between the state keys of BeMapNet's release and ours."""

from gsmap.checkpoints.key_rules import KeyMap, rules_of
from gsmap.models.lines.keys import (
    BEV,
    CLASS_WEIGHTS,
    HEAD_RULES,
    LINE_DECODER,
    LINE_DECODER_RULES,
    LINEAR,
    mlps,
)

_NECK = "im_backbone.fpn.model."
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
            BEV + "encoder.layers.{i}.",
            "bev_encoder.source_layers.{i}.",
            f"self_attn.=self_attn. norm1.=norms.0. {LINEAR} norm2.=norms.1.",
        ),
        *rules_of(
            BEV + "decoder.layers.{i}.",
            "bev_encoder.bev_layers.{i}.",
            f"self_attn.=self_attn. multihead_attn.=cross_attn. norm1.=norms.0. norm2.=norms.1. "
            f"norm3.=norms.2. {LINEAR}",
        ),
        *rules_of(
            BEV,
            "bev_encoder.",
            "input_proj. query_embed.=bev_embedding. decoder.norm.=norm. "
            "src_pos_embed_layer.encoder.=position.",
        ),
        *LINE_DECODER_RULES,
        *rules_of(
            LINE_DECODER,
            "map_head.decoder.",
            "query_feat.=query. query_embed.=query_pos. class_embed.=cls_branches.0.",
        ),
        *mlps(LINE_DECODER + "mask_embed.", "map_head.decoder.mask_branches.0."),
        *mlps("output_head.im_ctr_heads.{i}.", "map_head.joint_branches.{i}."),
        *mlps("output_head.ex_ctr_heads.{i}.", "map_head.inner_branches.{i}."),
        *mlps("output_head.npiece_heads.{i}.", "map_head.piece_branches.{i}."),
        *HEAD_RULES,
    ),
    CLASS_WEIGHTS,
    markers=((_NECK, "img_neck.rounds."),),
    idle=r"bev_decoder\.bev_encoder\.tgt_pos_embed_layer\.",  # listed twice there, one module
    sign=LINE_DECODER,
)

KEY_MAPS = (BEMAPNET,)
