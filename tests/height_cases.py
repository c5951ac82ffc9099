"""Annotation files whose points have a height, made from flat ones."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from gsmap.datasets.annotations.file import AnnotationFile, write_annotations
from gsmap.datasets.annotations.record import MapSample


def raised(sample: MapSample) -> MapSample:
    """Lay a sample's map on a slope: z = 0.1 x - 1.8."""
    assert sample.instances is not None
    instances = [
        replace(i, points=np.c_[i.points, 0.1 * i.points[:, 0] - 1.8]) for i in sample.instances
    ]
    return replace(sample, instances=instances)


def write_raised(flat: Path, target: Path) -> Path:
    """Write a file of two coordinates per point as one of three."""
    file = AnnotationFile(flat)
    write_annotations(target, replace(file.meta, dim=3), (raised(sample) for sample in file))
    return target
