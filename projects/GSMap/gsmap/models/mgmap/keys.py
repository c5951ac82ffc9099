"""Mapping between the state keys of the released MGMap and of this project.

A rule is a pair of key prefixes, released and here. It renames the beginning of a key, and the rest
of the key is kept. ``{i}`` stands for a number, which is equal on both sides.

`rules_of` makes several rules. It takes the prefix of the released keys, the prefix of this
project's keys, and one text of pairs, separated by blanks. A pair is ``released=here`` and extends
both prefixes.
"""

from gsmap.checkpoints.key_rules import KeyMap, Rules, rules_of
from gsmap.models.maptr.keys import CODE_WEIGHTS, GRID_OFFSETS, HEAD, MAPTR, TRANSFORMER

# Released prefix and prefix here of the network that enhances the BEV features.
_ENHANCED = TRANSFORMER + "bevencode."
_NECK = "map_head.decoder.neck."
# Residual blocks of the three stages of this network.
_BLOCKS = (
    (_ENHANCED + "layer1.{i}.", _NECK + "stages.0.{i}."),
    (_ENHANCED + "layer2.{i}.", _NECK + "stages.1.{i}."),
    (_ENHANCED + "layer3.{i}.", _NECK + "stages.2.{i}."),
)
# Network that predicts the masks of instances.
_MASK_NET = (TRANSFORMER + "decoder.ins_conv.", "map_head.decoder.mask_net.")


def _gate_rules() -> Rules:
    """Return the rules of the gates, the channel and spatial attention in each block."""
    rules: list[tuple[str, str]] = []
    for theirs, ours in _BLOCKS:
        rules += rules_of(theirs, ours, names="ca.fc.=gates.channel. sa.conv1.=gates.space.")
    return tuple(rules)


MGMAP = KeyMap(
    "mgmap",
    (
        _MASK_NET,
        (TRANSFORMER + "decoder.linear1.", "map_head.decoder.activation."),
        (HEAD + "pts_embedding_.", "map_head.pts_embedding."),
        *rules_of(
            _ENHANCED,
            _NECK,
            "conv1.=stem.0. bn1.=stem.1. conv_1.conv.=fusion.0. conv_1.bn.=fusion.1. "
            "neck.convs.{i}.conv.=levels.{i}.0. neck.convs.{i}.norm.=levels.{i}.1.",
        ),
        # The first rule that matches a key is applied, so the gates come before their blocks.
        *_gate_rules(),
        *_BLOCKS,
        *rules_of(
            HEAD,
            "map_head.decoder.",
            "conv_2.conv.=segmentation.0. conv_2.bn.=segmentation.1. "
            "semantic_output.=segmentation.3. change_channels.conv_expand.=mask_feature.expand. "
            "change_channels.conv_basicblock.=mask_feature.block. "
            "process_net.conv_reduce.=mask_feature.reduce. ",
        ),
        *rules_of(
            HEAD,
            "map_head.decoder.refinements.{i}.",
            "rcnn_net_{i}.=patch_net. rego_hs_linear_{i}.=memory.0. "
            "rego_hs_linear_norm_{i}.=memory.1. glimpse_transformer_{i}.decoder.layers.0.=layer. "
            "glimpse_transformer_{i}.decoder.norm.=norm. rego_hs_fuser_{i}.0.=fuser.0. "
            "layer_norms_{i}.0.=fuser.1.",
        ),
        # The remaining keys are named as in MapTR, on which MGMap is built.
        *MAPTR.rules,
    ),
    # Released keys without a counterpart here. Conversion back to the released format adds them.
    unused=CODE_WEIGHTS,
    # Keys of the mask network distinguish checkpoints of MGMap from checkpoints of MapTR.
    markers=(_MASK_NET,),
    # Further released keys without a counterpart, which conversion back leaves out: modules that
    # are never called, an alias of glimpse_transformer_0, weights of a loss, and fixed offsets.
    ignored_pattern=r"pts_bbox_head\.(conv_seg|glimpse_transformer|loss_fn_?|(cls|reg)_branches\.[6-9]|"
    r"transformer\.bevencode\.(fpn_conv|attention)|(rego_hs_fuser|layer_norms)_\d\.[1-5])\.|"
    + GRID_OFFSETS,
)

KEY_MAPS = (MGMAP,)
