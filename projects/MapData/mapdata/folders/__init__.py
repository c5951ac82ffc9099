"""Folders of images with a calibration file, as samples."""
