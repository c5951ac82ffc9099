"""Cases of general tests for this method."""

import upstream_configs

EXPORTS = {"as it is": ("configs/maptrv2/maptrv2_r18_minicity.py", {})}

DEPTH_AND_MASKS = "maptrv2/maptrv2_r50_24e"  # a data set with depth of LiDAR and both masks

ARGOVERSE2_DEPTH = "configs/maptrv2/maptrv2_r50_av2_depth_6e.py"

ALL_SETTINGS = "projects/GSMap/configs/gsmap_maptrv2_r18_minicity.py"  # every one of a GSMap counts

SWAPPED_BASES = ("maptrv2/maptrv2_r18_minicity",)

STEPS_OF_IMAGES = {  # colours of the smaller images are distorted, as released
    "maptrv2/maptrv2_r50_24e": ["ScaleImages", "DistortImages"],
    "maptrv2/maptrv2_r50_av2_6e": ["ScaleImages", "DistortImages"],
}

LOSSES = ("pts", ())  # field of the ground truth; losses that may be zero


def upstream_config() -> str:
    """Config of the authors' code."""
    attention = upstream_configs.ATTENTION.format(kind="MultiheadAttention", dropout=0.1)
    attentions = f"{attention}, {attention}"
    layer = upstream_configs.LAYER.format(self_attn=attentions, cross_attn=upstream_configs.CROSS)
    layer = layer.replace("DetrT", "DecoupledDetrT")
    losses = upstream_configs.LOSSES.format(pts=5.0, dir=0.005)
    parts = {
        "model": "MapTRv2",
        "queries": "num_vec_one2one=50, num_vec_one2many=300, k_one2many=6,",
        "layer": f"{layer}, num_vec=50, num_pts_per_vec=points",
        "order": "('self_attn', 'norm', 'self_attn', 'norm', 'cross_attn', 'norm', 'ffn', 'norm')",
        "losses": losses + upstream_configs.SEGMENTATION,
    }
    return upstream_configs.maptr(**(upstream_configs.LIFTED | parts))


UPSTREAM_CONFIGS = {"maptrv2/maptrv2_r50_24e": (upstream_config(), set())}
