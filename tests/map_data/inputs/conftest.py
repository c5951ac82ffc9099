"""A drive to record."""

import pytest

from gsmap.datasets.annotations.file import AnnotationFile


@pytest.fixture(scope="module")
def drive(minicity_root, minicity_annotations):
    return list(AnnotationFile(minicity_annotations["val"]))
