"""Cases of general tests for this method."""

DEFORMABLE = {"type": "SpatialCrossAttention", "num_heads": 4, "num_points": 8, "num_heights": 4}
EXPORTS = {
    "BEVFormer": (
        "configs/gemap/gemap_r18_minicity.py",
        {"model.bev_encoder.cross_attn": {"_delete_": True, **DEFORMABLE}},
    )
}
