"""HDMapNet (ICRA 2022), which traces lines in maps of classes, instances and directions."""
