"""Importing this module registers everything that GSMap adds to mmdet3d's registries."""
