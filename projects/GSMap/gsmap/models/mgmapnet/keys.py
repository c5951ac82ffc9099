"""Mapping between the state keys of the released MGMapNet and of this project.

`rules_of` takes the common prefix of released keys, the common prefix of the keys here, and a text.
Each word of the text continues both prefixes: ``released=here``, or one name for both. `zeros`
lists keys of the release that have no effect there, and no counterpart here.
"""

from gsmap.checkpoints.key_rules import KeyMap, rules_of, zeros
from gsmap.models.maptr.keys import DECODER, DECODER_LAYER, DECODER_RULES, HEAD, LAYER, TRANSFORMER
from gsmap.models.maptrv2.keys import LIFTED_RULES, LIFTED_UNUSED

_INTERACTION = (
    "cross_attn.=attn. linear1.=ffn.layers.0.0. linear2.=ffn.layers.1. norm1.=norms.0. "
    "norm3.=norms.1."
)
# Key prefixes (released, ours) of a module that only this architecture has.
_DOWN_SAMPLING = (TRANSFORMER + "bev_downsample.", "map_head.decoder.bev_pyramid.merges.0.")
_IDLE = "attentions.1.output_proj_instance"  # a projection that the release never calls
_NORM = ("weight", "bias", "running_mean", "running_var")
MGMAPNET = KeyMap(
    "mgmapnet",
    (
        *LIFTED_RULES,
        (HEAD + "ins_seg_head.", "map_head.losses.ins_seg.embedding."),
        _DOWN_SAMPLING,
        *rules_of(
            DECODER_LAYER + "attentions.1.p2p_attention.", LAYER + "cross_attn.p2p.", _INTERACTION
        ),
        *rules_of(
            DECODER_LAYER + "attentions.1.p2i_attention.", LAYER + "cross_attn.p2i.", _INTERACTION
        ),
        *rules_of(
            DECODER_LAYER + "attentions.1.",
            LAYER + "cross_attn.",
            "point_pos.=point_code. instance_pos.=instance_code. output_proj_point.=output_proj. "
            "point2ins_proj.=instance_mlp.",
        ),
        *DECODER_RULES,
        *rules_of(
            DECODER,
            LAYER,
            "point_ffn.{i}.=point_ffn. point_norm.{i}.=point_norm. "
            "gen_pos_embed.{i}.=reference_code.",
        ),
    ),
    unused={
        **LIFTED_UNUSED,
        HEAD + "loss_seg.loss_fn.pos_weight": None,  # a loss without counterpart
        **zeros(
            HEAD,
            {
                # an unused embedding of the points
                "pts_embedding.weight": (20, 512),
                # the second mask head of the cameras, which is never called
                **{f"bev_pv_seg_head.{i}.weight": (256, 256, 3, 3) for i in (0, 3)},
                **{f"bev_pv_seg_head.{i}.{leaf}": (256,) for i in (1, 4) for leaf in _NORM},
                **{f"bev_pv_seg_head.{i}.num_batches_tracked": () for i in (1, 4)},
                "bev_pv_seg_head.6.weight": (3, 256, 1, 1),
                "bev_pv_seg_head.6.bias": (3,),
            },
        ),
        **zeros(
            DECODER,
            {
                # encoding of the reference points in the first layer, which uses the learned
                # position instead
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

KEY_MAPS = (MGMAPNET,)
