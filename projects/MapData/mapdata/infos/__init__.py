"""Info files of mmdet3d: ground truth to annotation files, recordings to samples."""
