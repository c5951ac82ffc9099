"""Mapping between the state keys of the released BeMapNet and of this project.

A rule is a pair of key prefixes, (released, here), in which ``{i}`` stands for any number.
`rules_of` makes several rules. It takes the common prefix of released keys, the common prefix of
the keys here, and a text. Each word of the text continues both prefixes: ``released=here``, or one
name for both. `mlps` makes the rules of the linear layers of an MLP from its two prefixes.
"""

from collections.abc import Sequence

from gsmap.checkpoints.key_rules import KeyMap, Rules, rules_of
from gsmap.models.lines.keys import (
    BEV,
    CLASS_WEIGHTS,
    HEAD_RULES,
    LINE_DECODER,
    LINE_DECODER_RULES,
    LINEAR,
    mlps,
)

_NECK = "im_backbone.fpn.model."  # prefix of the neck (a BiFPN) in the release
# Words for `rules_of`: the layers of a separable convolution of the neck.
_CONVS = "depthwise_conv.conv.=depthwise. pointwise_conv.conv.=pointwise. bn.=norm."
# Convolutions that project backbone features to the channels of the neck: names in the release, and
# their names here.
_PROJECTIONS = {
    "p3_down_channel.": "inputs.0.",
    "p4_down_channel.": "inputs.1.",
    "p5_down_channel.": "inputs.2.",
    "p4_down_channel_2.": "again.0.",
    "p5_down_channel_2.": "again.1.",
    "p5_to_p6.": "coarser.",
}


def _path_rules(path: str, release_path: str, number: int, levels: Sequence[int]) -> Rules:
    """Return the rules of one path of a BiFPN round.

    Args:
        path: Name of the path, ``down`` or ``up``.
        release_path: Name of the path in the release.
        number: Number of the path in the names of the fusion weights of the release.
        levels: Numbers of the levels of the pyramid in the order of the path.
    """
    rules: list[tuple[str, str]] = []
    for i, level in enumerate(levels):
        # {{i}} becomes the placeholder {i} of a rule, for the number of the round. {i} inserts the
        # position of the level on the path.
        theirs = f"{_NECK}{{i}}."
        ours = f"img_neck.rounds.{{i}}.{path}.{i}."
        rules += rules_of(f"{theirs}conv{level}_{release_path}.", ours, names=_CONVS)
        rules.append((f"{theirs}p{level}_w{number}", f"{ours}weights"))
    return tuple(rules)


def _projection_rules() -> Rules:
    """Return the rules of the projections: a convolution, and the batch norm after it.

    In the release, the convolution is within one more module (``0.conv.`` instead of ``0.``).
    """
    rules: list[tuple[str, str]] = []
    for theirs, ours in _PROJECTIONS.items():
        rules.append((f"{_NECK}0.{theirs}0.conv.", f"img_neck.{ours}0."))
        rules.append((f"{_NECK}0.{theirs}1.", f"img_neck.{ours}1."))
    return tuple(rules)


# The path "down" of this project is called "up" in the release, and the path "up" is called "down".
_NECK_RULES = (
    *_path_rules("down", release_path="up", number=1, levels=(6, 5, 4, 3)),
    *_path_rules("up", release_path="down", number=2, levels=(4, 5, 6, 7)),
    *_projection_rules(),
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
    unused=CLASS_WEIGHTS,  # released keys without a counterpart here
    # Key prefixes, in the release and here, that distinguish this architecture from others.
    markers=((_NECK, "img_neck.rounds."),),
    # The release saves the weights of `src_pos_embed_layer` a second time under this name.
    ignored_pattern=r"bev_decoder\.bev_encoder\.tgt_pos_embed_layer\.",
    upstream_prefix=LINE_DECODER,  # only released keys have it
)

KEY_MAPS = (BEMAPNET,)
