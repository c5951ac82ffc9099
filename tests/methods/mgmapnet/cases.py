"""Cases of general tests for this method."""

# With Gaussians, and an LSS of images alone; another method exports one with their calibration
EXPORTS = {
    "with Gaussians": (
        "projects/GSMap/configs/gsmap_mgmapnet_r18_minicity.py",
        {"model.bev_encoder.camera_aware": False},
    )
}
STATIC_FRAMES = {"as it is": ("configs/mgmapnet/mgmapnet_r18_minicity.py", {})}
