"""Samples of folders of images with a calibration file."""
