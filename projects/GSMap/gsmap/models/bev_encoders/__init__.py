"""Encoders from camera and LiDAR features to BEV features."""
