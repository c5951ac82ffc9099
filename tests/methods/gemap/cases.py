"""Cases of general tests for this method."""

import upstream_configs

DEFORMABLE = {"type": "SpatialCrossAttention", "num_heads": 4, "num_points": 8, "num_heights": 4}
EXPORTS = {
    "BEVFormer": (
        "configs/gemap/gemap_r18_minicity.py",
        {
            "model.bev_encoder.cross_attn": {"_delete_": True, **DEFORMABLE},
            # a graph has the operators of each camera
            "model.bev_encoder.num_cams": 2,
            "test_dataloader.dataset.cameras": ["CAM_FRONT", "CAM_BACK"],
        },
    )
}

UPSTREAM_LOSSES = upstream_configs.LOSSES.format(pts=5.0, dir=0.005) + (
    ", use_geo_loss=True, intra_loss_weight=1.0, inter_loss_weight=1.0, loss_geo=dict("
    "type='GeometricLoss', loss_weight=0.005, intra_loss_weight=1.0, inter_loss_weight=1.0, "
    "num_ins=50, num_pts=points, pc_range=range_m, loss_type='l1')"
)
SHARED = {  # by the simple and the full objective of the authors' code
    "prefix": "GeMap",
    "layer": upstream_configs.decoder_layer("GeometryDecoupledAttention"),
    "decay": 0.03,
    "evaluate": 1,
}
SIMPLE = upstream_configs.maptr(**SHARED, model="GeMap", losses=UPSTREAM_LOSSES)
FULL_SETTINGS = {
    "model": "GeMapFull",
    "frozen": -1,
    "epochs": 110,
    "losses": UPSTREAM_LOSSES + upstream_configs.SEGMENTATION,
}
FULL = upstream_configs.maptr(**(upstream_configs.LIFTED | SHARED | FULL_SETTINGS))

UPSTREAM_CONFIGS = {"gemap/gemap_simple_r50_24e": (SIMPLE, {"model.map_head.loss_euclidean"})}
UPSTREAM_HEADS = {"gemap/gemap_simple_r50_24e": SIMPLE, "gemap/gemap_full_r50_110e": FULL}
