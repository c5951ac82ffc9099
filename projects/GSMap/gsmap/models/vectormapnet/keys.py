"""Mapping between the state keys of the released VectorMapNet and of this project.

The first two arguments of `rules_of` are the prefixes of keys in the release and here. The text
lists the rest of each key, as ``released=here`` or as one name that both have. ``{i}`` stands for a
number. All entries are prefixes of keys, and most of them end with a dot.
`zeros` lists keys of the release that have no effect there and no counterpart here. When weights
are converted to the release, the values in ``unused`` are written; a key with None is not written.
"""

import torch

from gsmap.checkpoints.key_rules import KeyMap, rules_of, zeros

# Prefixes in the release: the detector of elements, and the generator of the vertices of their
# lines.
_ELEMENTS = "head.det_net."
_ELEMENT_LAYER = "head.det_net.transformer.decoder.layers.{i}."
_LINES = "head.gen_net."
# Coordinates z, y and x of the sampled planes, which the release saves as a buffer.
_PLANES = torch.meshgrid(
    torch.tensor((-1.1, 0.0, 0.5, 1.1)),
    torch.linspace(-15.0, 15.0, 100),
    torch.linspace(-30.0, 30.0, 200),
    indexing="ij",
)
VECTORMAPNET = KeyMap(
    "vectormapnet",
    (
        *rules_of("backbone.", "", "img_backbone. img_neck."),
        ("backbone.upsample.fscale.1.", "bev_encoder.upsampling.0."),
        ("backbone.upsample.fscale.2.", "bev_encoder.upsampling.1."),
        ("backbone.upsample.fscale.3.", "bev_encoder.upsampling.2."),
        ("backbone.outconvs.", "bev_encoder.reduction."),
        ("neck.", "bev_encoder.neck."),
        *rules_of(
            _ELEMENT_LAYER,
            "map_head.detector.layers.{i}.",
            "attentions.0.attn.=self_attn. attentions.1.=cross_attn. ffns.0.=ffn. norms.",
        ),
        *rules_of(
            _ELEMENTS,
            "map_head.detector.",
            "transformer.reference_points_embed.=initial. input_proj.=context.project. "
            "img_coord_embed.=context.code. query_embedding.=elements. bbox_embedding.=corners. "
            "pre_branches.cls.0.=cls_branch. pre_branches.reg.0.=corner_branch.",
        ),
        *rules_of(
            _LINES + "decoder.layers.{i}.",
            "map_head.generator.layers.{i}.",
            "self_attn. multihead_attn.=cross_attn. linear1.=ffn.0. linear2.=ffn.3. "
            "norm1.=norms.0. norm2.=norms.1. norm3.=norms.2. "
            "res_weight1=gates.0 res_weight2=gates.1 res_weight3=gates.2",
        ),
        *rules_of(
            _LINES,
            "map_head.generator.",
            "_project_to_logits.=logits. input_proj.=context.project. "
            "img_coord_embed.=context.code. label_embed.=label. coord_embed.=axis. "
            "pos_embeddings.=position. "
            "bbox_context_embed.=corner. vertex_embed.=vertex.",
        ),
    ),
    unused={
        # buffers with settings: the points (x, y, z) of the planes, the size of the canvas in
        # pixels, and two settings of the noise
        "backbone.bev_planes": torch.stack((_PLANES[2], _PLANES[1], _PLANES[0]), -1),
        _ELEMENTS + "canvas_size": torch.tensor((200, 100)),
        _LINES + "canvas_size": torch.tensor((200, 100)),
        "head.augmentation.canvas_size": torch.tensor((200, 100)),
        "head.augmentation.shift_scale": None,
        "head.augmentation.scaling_size": None,
        # parameters without effect: an unused table, and embeddings of the only level and of the
        # labels
        "backbone.masked_embeds.weight": torch.zeros(()).expand(4, 128),
        **zeros(_ELEMENTS, {"transformer.level_embeds": (1, 256), "label_embed.weight": (3, 256)}),
    },
    # prefixes, in the release and here, that identify the architecture
    markers=((_LINES, "map_head.generator."),),
    # in the release, the branches of index 1 and higher are further names of the branch of index 0
    ignored_pattern=r"head\.det_net\.pre_branches\.(cls|reg)\.[1-9]",
    upstream_prefix=_LINES,
)

KEY_MAPS = (VECTORMAPNET,)
