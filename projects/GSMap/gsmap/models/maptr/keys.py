"""State keys of the released MapTR and their names here, with rules that other models use.

`rules_of` makes pairs of key prefixes, one of the release and one here. Its first two arguments are
the beginnings of the keys in the release and here. Its third argument lists how the keys go on:
``released=here``, or one name that both have. ``{i}`` stands for the number of a layer. The first
pair that matches a key is applied.
"""

import torch

from gsmap.checkpoints.key_rules import KeyMap, rules_of

# Prefixes in the release.
HEAD = "pts_bbox_head."
TRANSFORMER = "pts_bbox_head.transformer."
ENCODER = "pts_bbox_head.transformer.encoder."
ENCODER_LAYER = "pts_bbox_head.transformer.encoder.layers.{i}."
DECODER = "pts_bbox_head.transformer.decoder."
DECODER_LAYER = "pts_bbox_head.transformer.decoder.layers.{i}."
# Prefixes here.
OUR_ENCODER_LAYER = "bev_encoder.layers.{i}."
LAYER = "map_head.decoder.layers.{i}."

COMMON_RULES = (
    *rules_of("", "", "img_backbone. img_neck."),
    *rules_of(HEAD, "map_head.", "instance_embedding. pts_embedding. cls_branches."),
    *rules_of(HEAD, "map_head.reference.", "reg_branches.=branches."),
    *rules_of(TRANSFORMER, "map_head.reference.", "reference_points.=initial."),
)
DECODER_RULES = rules_of(
    DECODER_LAYER,
    LAYER,
    "attentions.0.attn.=self_attn. attentions.1.=cross_attn. ffns.0.=ffn. norms.",
)
# Rules of both encoders with BEV queries, without the rules of their sampling in cross-attention.
_BEV_QUERY_RULES = (
    *COMMON_RULES,
    *DECODER_RULES,
    *rules_of(HEAD, "bev_encoder.", "bev_embedding. positional_encoding."),
    *rules_of(TRANSFORMER, "bev_encoder.", "level_embeds cams_embeds can_bus_mlp."),
    *rules_of(ENCODER_LAYER, OUR_ENCODER_LAYER, "attentions.0.=self_attn. ffns.0.=ffn. norms."),
    *rules_of(
        ENCODER_LAYER, OUR_ENCODER_LAYER, "attentions.1.output_proj.=cross_attn.output_proj."
    ),
)
# Weights of box coordinates, which the releases use only in a loss that they switch off. They have
# no counterpart here. A conversion to the released format writes these values.
CODE_WEIGHTS = {HEAD + "code_weights": torch.ones(4)}

# Fixed offsets of the cross-attention's kernel, which MapTR's released code saves as a buffer.
GRID_OFFSETS = (
    r"pts_bbox_head\.transformer\.encoder\.layers\.\d+\.attentions\.1\.attention\.grid_offsets"
)
# Prefixes (released, here) of the cross-attention with a fixed kernel.
_KERNELS = (ENCODER_LAYER + "attentions.1.attention.", OUR_ENCODER_LAYER + "cross_attn.")
# Released prefix of the deformable cross-attention.
_DEFORMABLE = ENCODER_LAYER + "attentions.1.deformable_attention."
MAPTR = KeyMap(
    "maptr", (*_BEV_QUERY_RULES, _KERNELS), unused=CODE_WEIGHTS, ignored_pattern=GRID_OFFSETS
)
# Keys belong to this map only if they contain the marker, in the release or here. Checkpoints with
# the marker have deformable cross-attention and are not of MapTR itself.
MAPTR_BEVFORMER = KeyMap(
    "maptr-bevformer",
    (*_BEV_QUERY_RULES, (_DEFORMABLE, OUR_ENCODER_LAYER + "cross_attn.")),
    unused=CODE_WEIGHTS,
    markers=((_DEFORMABLE, OUR_ENCODER_LAYER + "cross_attn.sampling_offsets."),),
)

KEY_MAPS = (MAPTR_BEVFORMER, MAPTR)  # MAPTR has no marker and would match both, so it is last
