"""Mapping between the state keys of the released MGMapNet and of this project.

`rules_of` takes the common prefix of released keys, the common prefix of the keys here, and a text.
Each word of the text continues both prefixes: ``released=here``, or one name for both. In a prefix
and in a text, ``{i}`` stands for the number of a layer. It is equal on both sides, but may stand at
another place.

`zeros` lists keys of the release that have no effect there, and no counterpart here. Conversion to
the release writes zeros for them, so their shapes are listed.
"""

from gsmap.checkpoints.key_rules import KeyMap, rules_of, zeros
from gsmap.models.maptr.keys import DECODER, DECODER_LAYER, DECODER_RULES, HEAD, LAYER, TRANSFORMER
from gsmap.models.maptrv2.keys import LIFTED_RULES, LIFTED_UNUSED

# HEAD, TRANSFORMER, DECODER and DECODER_LAYER are prefixes of released keys. LAYER is the prefix of
# a decoder layer here. LIFTED_RULES and LIFTED_UNUSED are the rules and the unused keys of MapTRv2
# outside of the decoder. The BEV encoder of MapTRv2 lifts image features along predicted depth, and
# MGMapNet has this encoder, too.

# Keys of an interaction, an attention with a feed-forward network. A layer has two: among points
# (p2p), and from points to instances (p2i).
_INTERACTION = (
    "cross_attn.=attn. linear1.=ffn.layers.0.0. linear2.=ffn.layers.1. norm1.=norms.0. "
    "norm3.=norms.1."
)
# Key prefixes (released, here) of a module that only this architecture has.
_DOWN_SAMPLING = (TRANSFORMER + "bev_downsample.", "map_head.decoder.bev_pyramid.merges.0.")
_IDLE = "attentions.1.output_proj_instance"  # a projection that the release never calls
_NORM = ("weight", "bias", "running_mean", "running_var")  # state of BatchNorm
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
        # In the release, the number of the layer follows the name of these modules.
        *rules_of(
            DECODER,
            LAYER,
            "point_ffn.{i}.=point_ffn. point_norm.{i}.=point_norm. "
            "gen_pos_embed.{i}.=reference_code.",
        ),
    ),
    # Released keys without a counterpart here, with the values that conversion to the release
    # writes.
    unused={
        **LIFTED_UNUSED,
        # Weight of a loss without a counterpart, which only some released files have. Because of
        # None, it is not written.
        HEAD + "loss_seg.loss_fn.pos_weight": None,
        **zeros(
            HEAD,
            {
                # An unused embedding of the points.
                "pts_embedding.weight": (20, 512),
                # The second mask head of the cameras, which is never called. It is a sequence with
                # convolutions (0, 3, 6), the first two of which are followed by BatchNorm (1, 4).
                **{f"bev_pv_seg_head.{conv}.weight": (256, 256, 3, 3) for conv in (0, 3)},
                **{f"bev_pv_seg_head.{norm}.{leaf}": (256,) for norm in (1, 4) for leaf in _NORM},
                **{f"bev_pv_seg_head.{norm}.num_batches_tracked": () for norm in (1, 4)},
                "bev_pv_seg_head.6.weight": (3, 256, 1, 1),
                "bev_pv_seg_head.6.bias": (3,),
            },
        ),
        **zeros(
            DECODER,
            {
                # The encoding of the reference points in the first layer. It has no effect, because
                # this layer uses the learned position instead.
                "gen_pos_embed.0.0.weight": (256, 40),
                "gen_pos_embed.0.0.bias": (256,),
                "gen_pos_embed.0.2.weight": (256, 256),
                "gen_pos_embed.0.2.bias": (256,),
                # The projection of the aggregated instance query, which is never called.
                **{f"layers.{layer}.{_IDLE}.weight": (256, 256) for layer in range(6)},
                **{f"layers.{layer}.{_IDLE}.bias": (256,) for layer in range(6)},
            },
        ),
    },
    markers=(_DOWN_SAMPLING,),  # a checkpoint with these keys is of MGMapNet
)

KEY_MAPS = (MGMAPNET,)
