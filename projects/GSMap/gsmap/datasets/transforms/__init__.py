"""Pipeline transforms; importing the modules registers them in mmdet3d's ``TRANSFORMS``."""
