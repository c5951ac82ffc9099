"""Names of map classes whose elements are areas, and of those whose elements are lines."""

AREA_CLASSES = ("ped_crossing", "stop_line", "intersection", "carpark_area", "carpark")
"""Classes of areas: layers of nuScenes, and ``carpark``, another name of ``carpark_area``."""
LINE_CLASSES = ("divider", "boundary", "centerline")
"""Classes of lines, whose rings enclose no area of their own. A user may name others."""
DIRECTED_CLASSES = ("centerline",)
"""Classes of lines whose points are in the order of travel. All others are equal in reverse."""
