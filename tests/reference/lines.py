"""What checks of releases with one code for lines share: their cameras, their ground truth."""

import numpy as np

from gsmap.datasets.annotations.record import MapInstance
from reference.golden import Golden

CAMERAS = ("FRONT_LEFT", "FRONT", "FRONT_RIGHT", "BACK_LEFT", "BACK", "BACK_RIGHT")


def elements(golden: Golden, name: str) -> list[MapInstance]:
    """Return the elements of a set of ground truth, by class."""
    found = sorted(golden.gt_sets[name], key=lambda element: element["label"])
    return [MapInstance(element["label"], np.array(element["pts"])) for element in found]
