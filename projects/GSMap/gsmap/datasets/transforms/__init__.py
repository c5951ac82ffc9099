"""Transforms of the data pipeline, which are registered in ``TRANSFORMS`` of mmdet3d."""
