"""Names of map classes whose elements are areas."""

AREA_CLASSES = ("ped_crossing", "stop_line", "intersection", "carpark_area", "carpark")
"""Classes of areas: layers of nuScenes, and ``carpark``, another name of ``carpark_area``."""
