"""Mapping between the state keys of the released PivotNet and of this project.

`rules_of` takes the common prefix of released keys, the common prefix of the keys here, and a text.
Each word of the text continues both prefixes: ``released=here``, or one name for both. ``{i}``
stands for a number, which both keys have; ``{LINEAR}`` is replaced by its value, the names of the
layers of a feed-forward network. `mlps` takes the prefixes of a multilayer perceptron, in the
release and here.

``BEV`` and ``LINE_DECODER`` are prefixes of released keys. ``LINE_DECODER_RULES`` and
``HEAD_RULES`` are the rules that all heads of lines with masks have in common.
"""

import torch

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

PIVOTNET = KeyMap(
    "pivotnet",
    (
        ("im_backbone.bkb.", "img_backbone."),
        *rules_of(
            BEV + "encoder.layers.{i}.",
            "bev_encoder.source_layers.{i}.",
            f"self_attn.=attns.0. norm1.=norms.0. {LINEAR} norm2.=norms.1.",
        ),
        *rules_of(
            BEV + "decoder.layers.{i}.",
            "bev_encoder.bev_layers.{i}.",
            f"self_attn.=attns.0. norm2.=norms.0. cross_attn.=attns.1. norm1.=norms.1. {LINEAR} "
            "norm3.=norms.2.",
        ),
        *rules_of(
            BEV,
            "bev_encoder.",
            "input_proj. t2s_reference_points.=unseen_reference. "
            "src_pos_embed.{i}.pos_embed.=source_pos.{i}. "
            "tgt_pos_embed.pos_embed.=bev_pos. tgt_embed.pos_embed.=bev_embedding.",
        ),
        *LINE_DECODER_RULES,
        *rules_of(
            LINE_DECODER,
            "map_head.decoder.",
            "query_feat=query.weight query_embed=query_pos.weight class_embed.=cls_branches.",
        ),
        *mlps(LINE_DECODER + "mask_embed.{i}.", "map_head.decoder.mask_branches.{i}."),
        *mlps("output_head.im_ctr_heads.{i}.", "map_head.point_branches.{i}."),
        *mlps("output_head.pts_cls_heads.{i}.", "map_head.kind_branches.{i}."),
        *HEAD_RULES,
    ),
    # Released keys without a counterpart here, with the values that conversion to the release
    # writes.
    unused={
        **CLASS_WEIGHTS,  # class weights of the classification loss
        # Settings that the release stores as tensors: the order of the concatenated cameras, and
        # the class weights of a loss that is not used here.
        BEV + "image_order": torch.arange(6),
        "post_processor.criterion.collinear_pt_weight": torch.tensor((0.2, 1.0)),
    },
    # Pair of keys (released, here) by which a checkpoint of PivotNet is recognised.
    markers=((LINE_DECODER + "query_feat", "map_head.decoder.query.weight"),),
    upstream_prefix=LINE_DECODER,  # only released checkpoints have keys with this prefix
)

KEY_MAPS = (PIVOTNET,)  # read by `gsmap.checkpoints.key_map`
