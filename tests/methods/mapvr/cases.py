"""Cases of general tests for this method."""

import upstream_configs

LSS = {  # of images alone, without their calibration
    "type": "LSSEncoder",
    "_delete_": True,
    "bev_pixel_m": 1.2,
    "embed_dims": 128,
    "camera_aware": False,
}
# Another method exports this encoder
STATIC_FRAMES = {"LSS": ("configs/mapvr/mapvr_r18_minicity.py", {"model.bev_encoder": LSS})}


def upstream_config() -> str:
    """Config of the authors' code."""
    losses = upstream_configs.LOSSES.format(pts=1.0, dir=0.002)
    mask_loss = "loss_rendered_mask=dict(type='RenderedMaskDiceLoss', weight=15.0)"
    costs = upstream_configs.COST.format(pts=1.0)
    mask_cost = "rendered_mask_cost=dict(type='RenderedMaskDiceCost', weight=10.0)"
    return upstream_configs.maptr(
        encoder=upstream_configs.KERNEL.format(dropout=0.0),
        layer=upstream_configs.decoder_layer("MultiheadAttention", dropout=0.0),
        losses=f"{losses}, {mask_loss}",
        costs=f"{costs}, {mask_cost}",
        dropout=0.0,
        batch=8,
    )


UPSTREAM_HEADS = {"mapvr/mapvr_r50_24e": upstream_config()}
