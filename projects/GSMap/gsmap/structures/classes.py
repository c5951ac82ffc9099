"""Names of map classes that mean the same everywhere."""

AREA_CLASSES = ("ped_crossing", "stop_line", "intersection", "carpark_area", "carpark")
"""Classes whose elements enclose an area: nuScenes' layers, and MapVR's name of the fourth."""
