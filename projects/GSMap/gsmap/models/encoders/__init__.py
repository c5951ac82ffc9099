"""Encoders from camera and LiDAR features to BEV features, and image backbones."""
