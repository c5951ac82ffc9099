"""HDMapNet: lines from maps of classes, instances and directions."""
