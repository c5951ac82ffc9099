"""Cases of general tests for this method."""

LSS = {  # of images alone, without their calibration
    "type": "LSSEncoder",
    "_delete_": True,
    "bev_pixel_m": 1.2,
    "embed_dims": 128,
    "camera_aware": False,
}
EXPORTS = {"LSS": ("configs/mapvr/mapvr_r18_minicity.py", {"model.bev_encoder": LSS})}
