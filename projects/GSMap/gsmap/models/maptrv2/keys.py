"""Mapping between the state keys of the released MapTRv2 and of this project.

The conversion of checkpoints in both directions reads `KEY_MAPS`.

`rules_of` takes the common prefix of released keys, the common prefix of the keys here, and a text.
Each word of the text continues both prefixes: ``released=here``, or one name for both. `zeros`
lists keys of the release that have no effect there, and no counterpart here.
"""

import torch
from torch import Tensor

from gsmap.checkpoints.key_rules import KeyMap, rules_of, zeros
from gsmap.models.maptr.keys import CODE_WEIGHTS, COMMON_RULES, DECODER_LAYER, ENCODER, HEAD, LAYER

MASK_RULES = rules_of(HEAD, "map_head.aux_heads.", "seg_head.=seg. pv_seg_head.=pv_seg.")
# Weight of the foreground in a mask loss. The release stores it in the checkpoint; here it is a
# setting of the config.
MASK_WEIGHTS = {
    HEAD + "loss_seg.loss_fn.pos_weight": torch.tensor((4.0,)),
    HEAD + "loss_pv_seg.loss_fn.pos_weight": torch.tensor((1.0,)),
}

# Rules of models whose BEV encoder lifts image features along predicted depth (`LSSEncoder`).
LIFTED_RULES = (
    *COMMON_RULES,
    *MASK_RULES,
    *rules_of(ENCODER, "bev_encoder.", "depth_net. downsample."),
)
# Keys of the release without a counterpart here, and their values in a conversion to the release.
LIFTED_UNUSED: dict[str, Tensor | None] = {
    **CODE_WEIGHTS,
    # Modules of another encoder, with learned BEV queries. The release has them but never calls
    # them. Conversion to the release writes zeros of these shapes.
    **zeros(
        HEAD,
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
    # Grid of voxels, here a setting of the config: size of a voxel, centre of the first voxel and
    # number of voxels, each along x, y and z.
    ENCODER + "dx": torch.tensor((0.15, 0.15, 20.0)),
    ENCODER + "bx": torch.tensor((-14.925, -29.925, 0.0)),
    ENCODER + "nx": torch.tensor((200.0, 400.0, 1.0)),
    **MASK_WEIGHTS,
}
# Key prefixes (release, here) by which a checkpoint of these models is recognised, in either form.
LIFTED_MARKER = (ENCODER + "depth_net.", "bev_encoder.depth_net.depth_conv.")

MAPTRV2 = KeyMap(
    "maptrv2",
    (
        *LIFTED_RULES,
        *rules_of(
            DECODER_LAYER,
            LAYER,
            # The release has two self-attentions, between instances and between points, each with a
            # norm behind it. Here both belong to `self_attn`, with the norm between them, so the
            # numbers of the other norms are smaller by one.
            "attentions.0.attn.=self_attn.instance_attn. attentions.1.attn.=self_attn.point_attn. "
            "attentions.2.=cross_attn. ffns.0.=ffn. "
            "norms.0.=self_attn.norm. norms.1.=norms.0. norms.2.=norms.1. norms.3.=norms.2.",
        ),
    ),
    unused=LIFTED_UNUSED,
    markers=(LIFTED_MARKER,),
)

KEY_MAPS = (MAPTRV2,)
