"""The table between the state keys of the earlier systems and ours, read in both directions."""

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

_NUMBER = "{i}"


class UnusedKey(NamedTuple):
    """An upstream key that our model does not hold.

    Attributes:
        reason: Why nothing is lost without it.
        value: Makes the tensor that upstream expects there, for conversion back; None where only
            some of upstream's models hold the key.
    """

    reason: str
    value: Callable[[], Tensor] | None


@dataclass(frozen=True)
class KeyMap:
    """How the keys of one upstream architecture correspond to ours.

    Attributes:
        name: Name of the architecture.
        rules: Pairs of key prefixes (upstream's, ours); ``{i}`` stands for a number, the same on
            both sides, in order. The first that fits wins.
        unused: Upstream keys without a counterpart, whatever the rules say.
        markers: Pairs of key prefixes (upstream's, ours) that, all present, tell this architecture
            from those after it in ``KEY_MAPS``.
    """

    name: str
    rules: tuple[tuple[str, str], ...]
    unused: Mapping[str, UnusedKey] = field(default_factory=dict)
    markers: tuple[tuple[str, str], ...] = (("", ""),)

    def to_ours(self, key: str) -> str | None:
        """Return our name of an upstream key, or None if there is none."""
        return None if key in self.unused else _rename(key, self.rules)

    def to_upstream(self, key: str) -> str | None:
        """Return upstream's name of one of our keys, or None if there is none."""
        return _rename(key, tuple((ours, upstream) for upstream, ours in self.rules))


def _pattern(template: str) -> re.Pattern[str]:
    """Compile a key prefix in which ``{i}`` stands for a number."""
    return re.compile(r"(\d+)".join(re.escape(part) for part in template.split(_NUMBER)))


def _rename(key: str, rules: Iterable[tuple[str, str]]) -> str | None:
    """Replace the prefix of ``key`` by the first rule that fits."""
    for source, target in rules:
        match = _pattern(source).match(key)
        if match:
            for number in match.groups():
                target = target.replace(_NUMBER, number, 1)
            return target + key[match.end() :]
    return None


_HEAD = "pts_bbox_head."
_TRANSFORMER = "pts_bbox_head.transformer."
_ENCODER_LAYER = "pts_bbox_head.transformer.encoder.layers.{i}."
_DECODER_LAYER = "pts_bbox_head.transformer.decoder.layers.{i}."

IMAGE_RULES = (("img_backbone.", "img_backbone."), ("img_neck.", "img_neck."))
HEAD_RULES = (
    (_HEAD + "instance_embedding.", "map_head.instance_embedding."),
    (_HEAD + "pts_embedding.", "map_head.pts_embedding."),
    (_HEAD + "cls_branches.", "map_head.cls_branches."),
    (_HEAD + "reg_branches.", "map_head.reference.branches."),
    (_TRANSFORMER + "reference_points.", "map_head.reference.initial."),
)
DECODER_RULES = (
    (_DECODER_LAYER + "attentions.0.attn.", "map_head.decoder.layers.{i}.self_attn."),
    (_DECODER_LAYER + "attentions.1.", "map_head.decoder.layers.{i}.cross_attn."),
    (_DECODER_LAYER + "ffns.0.", "map_head.decoder.layers.{i}.ffn."),
    (_DECODER_LAYER + "norms.", "map_head.decoder.layers.{i}.norms."),
)
BEV_QUERY_RULES = (
    (_HEAD + "bev_embedding.", "bev_encoder.bev_embedding."),
    (_HEAD + "positional_encoding.", "bev_encoder.positional_encoding."),
    (_TRANSFORMER + "level_embeds", "bev_encoder.level_embeds"),
    (_TRANSFORMER + "cams_embeds", "bev_encoder.cams_embeds"),
    (_TRANSFORMER + "can_bus_mlp.", "bev_encoder.can_bus_mlp."),
    (_ENCODER_LAYER + "attentions.0.", "bev_encoder.layers.{i}.self_attn."),
    (
        _ENCODER_LAYER + "attentions.1.output_proj.",
        "bev_encoder.layers.{i}.cross_attn.output_proj.",
    ),
    (_ENCODER_LAYER + "ffns.0.", "bev_encoder.layers.{i}.ffn."),
    (_ENCODER_LAYER + "norms.", "bev_encoder.layers.{i}.norms."),
)
CODE_WEIGHTS = {
    _HEAD + "code_weights": UnusedKey(
        "weights of box coordinates, whose loss has weight 0", lambda: torch.ones(4)
    )
}

MAPTR = KeyMap(
    name="maptr",
    rules=(
        *IMAGE_RULES,
        *HEAD_RULES,
        *DECODER_RULES,
        *BEV_QUERY_RULES,
        (_ENCODER_LAYER + "attentions.1.attention.", "bev_encoder.layers.{i}.cross_attn."),
    ),
    unused=CODE_WEIGHTS,
)
MAPTR_BEVFORMER = KeyMap(
    name="maptr-bevformer",
    rules=(
        *IMAGE_RULES,
        *HEAD_RULES,
        *DECODER_RULES,
        *BEV_QUERY_RULES,
        (
            _ENCODER_LAYER + "attentions.1.deformable_attention.",
            "bev_encoder.layers.{i}.cross_attn.",
        ),
    ),
    unused=CODE_WEIGHTS,
    markers=(
        (
            _ENCODER_LAYER + "attentions.1.deformable_attention.",
            "bev_encoder.layers.{i}.cross_attn.sampling_offsets.",
        ),
    ),
)

_LAYER = "map_head.decoder.layers.{i}."
_V2_ENCODER = _TRANSFORMER + "encoder."
_BY_QUERIES = "part of the encoder with learned BEV queries, which depth lifting does not run"


def _unused_zeros(reason: str, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, UnusedKey]:
    """Return parameters that have no effect on any output: zeros do as well as what was trained."""
    return {key: UnusedKey(reason, partial(torch.zeros, shape)) for key, shape in shapes.items()}


def _constants(reason: str, values: Mapping[str, tuple[float, ...]]) -> dict[str, UnusedKey]:
    """Return numbers of the configuration that upstream keeps in its state."""
    return {key: UnusedKey(reason, partial(torch.tensor, value)) for key, value in values.items()}


LIFTED_RULES = (
    *IMAGE_RULES,
    *HEAD_RULES,
    (_HEAD + "seg_head.", "map_head.aux_heads.seg."),
    (_HEAD + "pv_seg_head.", "map_head.aux_heads.pv_seg."),
    (_V2_ENCODER + "depth_net.", "bev_encoder.depth_net."),
    (_V2_ENCODER + "downsample.", "bev_encoder.downsample."),
)
LIFTED_UNUSED = {
    **CODE_WEIGHTS,
    **_unused_zeros(
        _BY_QUERIES,
        {
            _HEAD + "positional_encoding.row_embed.weight": (200, 128),
            _HEAD + "positional_encoding.col_embed.weight": (100, 128),
            _TRANSFORMER + "level_embeds": (4, 256),
            _TRANSFORMER + "cams_embeds": (6, 256),
            _TRANSFORMER + "can_bus_mlp.0.weight": (128, 18),
            _TRANSFORMER + "can_bus_mlp.0.bias": (128,),
            _TRANSFORMER + "can_bus_mlp.2.weight": (256, 128),
            _TRANSFORMER + "can_bus_mlp.2.bias": (256,),
            _TRANSFORMER + "can_bus_mlp.norm.weight": (256,),
            _TRANSFORMER + "can_bus_mlp.norm.bias": (256,),
        },
    ),
    **_constants(
        "the grid of voxels, which the config says: size, first centre and number (x, y, z)",
        {
            _V2_ENCODER + "dx": (0.15, 0.15, 20.0),
            _V2_ENCODER + "bx": (-14.925, -29.925, 0.0),
            _V2_ENCODER + "nx": (200.0, 400.0, 1.0),
        },
    ),
    **_constants(
        "weight of the foreground in a mask loss, which the config says",
        {
            _HEAD + "loss_seg.loss_fn.pos_weight": (4.0,),
            _HEAD + "loss_pv_seg.loss_fn.pos_weight": (1.0,),
        },
    ),
}
LIFTED_MARKER = (_V2_ENCODER + "depth_net.", "bev_encoder.depth_net.depth_conv.")

MAPTRV2 = KeyMap(
    name="maptrv2",
    rules=(
        *LIFTED_RULES,
        (_DECODER_LAYER + "attentions.0.attn.", _LAYER + "self_attn.instance_attn."),
        (_DECODER_LAYER + "attentions.1.attn.", _LAYER + "self_attn.point_attn."),
        (_DECODER_LAYER + "attentions.2.", _LAYER + "cross_attn."),
        (_DECODER_LAYER + "ffns.0.", _LAYER + "ffn."),
        (_DECODER_LAYER + "norms.0.", _LAYER + "self_attn.norm."),
        (_DECODER_LAYER + "norms.1.", _LAYER + "norms.0."),
        (_DECODER_LAYER + "norms.2.", _LAYER + "norms.1."),
        (_DECODER_LAYER + "norms.3.", _LAYER + "norms.2."),
    ),
    unused=LIFTED_UNUSED,
    markers=(LIFTED_MARKER,),
)

# The names are those of upstream since 2023-12-12. Before, upstream called the attention among
# instances "intra" and the one within each "inter", and no key tells the two apart.
GEOMETRY_MARKER = (
    _DECODER_LAYER + "attentions.0.inter_",
    "map_head.decoder.layers.{i}.self_attn.inter.",
)
GEOMETRY_RULES = (
    GEOMETRY_MARKER,
    (_DECODER_LAYER + "attentions.0.intra_", "map_head.decoder.layers.{i}.self_attn.intra."),
)
GEMAP = KeyMap(
    name="gemap",
    rules=(*GEOMETRY_RULES, *MAPTR.rules),
    unused={
        **CODE_WEIGHTS,
        # On Argoverse 2, the simple objective is the full one's head with its parts switched off.
        _HEAD + "tau": UnusedKey("a number that no computation reads", None),
        _HEAD + "loss_seg.loss_fn.pos_weight": UnusedKey("weight in a loss that is off", None),
        _HEAD + "loss_pv_seg.loss_fn.pos_weight": UnusedKey("weight in a loss that is off", None),
    },
    markers=(GEOMETRY_MARKER,),
)
GEMAP_FULL = KeyMap(
    name="gemap-full",
    rules=(*GEOMETRY_RULES, *LIFTED_RULES, *DECODER_RULES),
    unused={
        **LIFTED_UNUSED,
        _HEAD + "tau": UnusedKey(
            "a number that no computation reads", lambda: torch.full((1,), 0.1)
        ),
    },
    markers=(GEOMETRY_MARKER, LIFTED_MARKER),
)

_MG_ATTENTION = _DECODER_LAYER + "attentions.1."
_INTERACTION_RULES = tuple(
    (f"{_MG_ATTENTION}{kind}_attention.{upstream}.", f"{_LAYER}cross_attn.{kind}.{ours}.")
    for kind in ("p2p", "p2i")
    for upstream, ours in (
        ("cross_attn", "attn"),
        ("linear1", "ffn.layers.0.0"),
        ("linear2", "ffn.layers.1"),
        ("norm1", "norms.0"),
        ("norm3", "norms.1"),
    )
)
_SECOND_PV = _HEAD + "bev_pv_seg_head."
_DOWN_SAMPLING = (
    _TRANSFORMER + "bev_downsample.",
    "map_head.decoder.bev_pyramid.merges.0.",
)
MGMAPNET = KeyMap(
    name="mgmapnet",
    rules=(
        *LIFTED_RULES,
        (_HEAD + "ins_seg_head.", "map_head.losses.ins_seg.embedding."),
        _DOWN_SAMPLING,
        *_INTERACTION_RULES,
        (_MG_ATTENTION + "point_pos.", _LAYER + "cross_attn.point_code."),
        (_MG_ATTENTION + "instance_pos.", _LAYER + "cross_attn.instance_code."),
        (_MG_ATTENTION + "output_proj_point.", _LAYER + "cross_attn.output_proj."),
        (_MG_ATTENTION + "point2ins_proj.", _LAYER + "cross_attn.instance_mlp."),
        *DECODER_RULES,
        (_TRANSFORMER + "decoder.point_ffn.{i}.", _LAYER + "point_ffn."),
        (_TRANSFORMER + "decoder.point_norm.{i}.", _LAYER + "point_norm."),
        (_TRANSFORMER + "decoder.gen_pos_embed.{i}.", _LAYER + "reference_code."),
    ),
    unused={
        **LIFTED_UNUSED,
        _HEAD + "loss_seg.loss_fn.pos_weight": UnusedKey("a loss that MGMapNet has not", None),
        **_unused_zeros(
            "embedding of the points, which MGMapNet's queries do not use",
            {_HEAD + "pts_embedding.weight": (20, 512)},
        ),
        **_unused_zeros(
            "code of the first layer's reference, which adds the learned position instead",
            {
                _TRANSFORMER + "decoder.gen_pos_embed.0.0.weight": (256, 40),
                _TRANSFORMER + "decoder.gen_pos_embed.0.0.bias": (256,),
                _TRANSFORMER + "decoder.gen_pos_embed.0.2.weight": (256, 256),
                _TRANSFORMER + "decoder.gen_pos_embed.0.2.bias": (256,),
            },
        ),
        **_unused_zeros(
            "projection of the aggregated instance query, which is never called",
            {
                f"{_MG_ATTENTION}output_proj_instance.{leaf}".replace(_NUMBER, str(layer)): shape
                for layer in range(6)
                for leaf, shape in (("weight", (256, 256)), ("bias", (256,)))
            },
        ),
        **_unused_zeros(
            "second mask head of the camera view, which is never called",
            {
                **{f"{_SECOND_PV}{i}.weight": (256, 256, 3, 3) for i in (0, 3)},
                **{
                    f"{_SECOND_PV}{i}.{leaf}": (256,)
                    for i in (1, 4)
                    for leaf in ("weight", "bias", "running_mean", "running_var")
                },
                **{f"{_SECOND_PV}{i}.num_batches_tracked": () for i in (1, 4)},
                _SECOND_PV + "6.weight": (3, 256, 1, 1),
                _SECOND_PV + "6.bias": (3,),
            },
        ),
    },
    markers=(_DOWN_SAMPLING,),
)

KEY_MAPS: list[KeyMap] = [MGMAPNET, GEMAP_FULL, GEMAP, MAPTRV2, MAPTR_BEVFORMER, MAPTR]
"""Known architectures, the most special first; the last needs no marker."""


def is_upstream(keys: Iterable[str]) -> bool:
    """Return whether state keys are in the format of the earlier systems."""
    return any(key.startswith(_HEAD) for key in keys)


def find_key_map(keys: Iterable[str]) -> KeyMap:
    """Return the map of the architecture that state keys, upstream's or ours, belong to."""
    keys = list(keys)
    side = 0 if is_upstream(keys) else 1
    for key_map in KEY_MAPS:
        patterns = [_pattern(pair[side]) for pair in key_map.markers]
        if all(any(pattern.match(key) for key in keys) for pattern in patterns):
            return key_map
    raise ValueError("the checkpoint holds no weights.")
