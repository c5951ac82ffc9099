"""Cases of general tests for this method."""

EXPORTS = {
    "as it is": ("configs/mgmapnet/mgmapnet_r18_minicity.py", {}),
    "with Gaussians": ("projects/GSMap/configs/gsmap_mgmapnet_r18_minicity.py", {}),
}
