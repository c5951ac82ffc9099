"""Names of map classes that mean the same everywhere."""

AREA_CLASSES = ("ped_crossing", "stop_line", "intersection", "carpark_area")
