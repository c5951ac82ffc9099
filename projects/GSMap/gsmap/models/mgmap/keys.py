"""The table between the state keys of MGMap's release and ours."""

from gsmap.checkpoints.key_rules import KeyMap, rules_of
from gsmap.models.maptr.keys import CODE_WEIGHTS, GRID_OFFSETS, HEAD, MAPTR, TRANSFORMER

_ENHANCED = TRANSFORMER + "bevencode."
_NECK = "map_head.decoder.neck."
_BLOCKS = tuple((f"{_ENHANCED}layer{n + 1}.{{i}}.", f"{_NECK}stages.{n}.{{i}}.") for n in range(3))
_ACTIVATION = (TRANSFORMER + "decoder.ins_conv.", "map_head.decoder.mask_net.")
MGMAP = KeyMap(
    "mgmap",
    (
        _ACTIVATION,
        (TRANSFORMER + "decoder.linear1.", "map_head.decoder.activation."),
        (HEAD + "pts_embedding_.", "map_head.pts_embedding."),
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
        *MAPTR.rules,
    ),
    CODE_WEIGHTS,
    markers=(_ACTIVATION,),
    # never called, but for a second name of glimpse_transformer_0 and weights in a loss
    idle=r"pts_bbox_head\.(conv_seg|glimpse_transformer|loss_fn_?|(cls|reg)_branches\.[6-9]|"
    r"transformer\.bevencode\.(fpn_conv|attention)|(rego_hs_fuser|layer_norms)_\d\.[1-5])\.|"
    + GRID_OFFSETS,
)

KEY_MAPS = (MGMAP,)
