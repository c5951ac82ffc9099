"""HDMapNet: maps of classes, instances and directions, and lines from them."""
