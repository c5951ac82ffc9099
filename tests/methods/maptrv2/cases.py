"""Cases of general tests for this method."""

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
