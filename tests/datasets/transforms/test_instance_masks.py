"""MakeInstanceMasks: which element has a cell, by hand."""

import numpy as np
import pytest
import torch
from mmengine.structures import InstanceData

from gsmap.datasets.annotations.record import MapInstance
from gsmap.datasets.transforms.masks import MakeBEVMask, MakeInstanceMasks, MakePVMask


def masks(*elements, **settings):
    """Vertical lines (label, column) on 6 x 9 cells of a metre."""
    instances = [
        MapInstance(label, np.array([[column + 0.5, -9.0], [column + 0.5, 9.0]]))
        for label, column in elements
    ]
    results = {
        "map_instances": instances,
        "x_range": (0.0, 9.0),
        "y_range": (0.0, 6.0),
        "gt_instances_3d": InstanceData(labels_3d=torch.zeros(len(instances))),
    }
    settings = {"size": (6, 9), "thickness_px": 1, "gap_px": 3, "mirrored": False} | settings
    drawn = MakeInstanceMasks(**settings).transform(results)["gt_instances_3d"].masks
    assert drawn.shape == (len(elements), 6, 9)
    assert all(mask.all(0).equal(mask.any(0)) for mask in drawn)  # whole columns
    return [mask[0].nonzero().flatten().tolist() for mask in drawn]


def test_each_element_has_its_own_cells():
    assert masks((0, 1), (2, 6)) == [[1], [6]]
    assert masks((0, 1), mirrored=True) == [[7]]


def test_the_later_one_of_a_class_has_the_cells_of_both():
    # OpenCV draws such a line of thickness 3 over five cells
    assert masks((1, 3), (1, 4), thickness_px=3) == [[1], [2, 3, 4, 5, 6]]


def test_near_a_later_class_all_give_way():
    assert masks((2, 4), (0, 2), (0, 7)) == [[4], [], [7]]
    assert masks((0, 4), (0, 4), (1, 5)) == [[], [], [5]]


@pytest.mark.parametrize(
    ("transform", "settings", "message"),
    [
        (MakeInstanceMasks, {"gap_px": -1}, "gap_px must be more than 0, got -1"),
        (MakeInstanceMasks, {"size": (0, 9)}, "rows must be more than 0"),
        (MakeBEVMask, {"size": (6, -9)}, "columns must be more than 0"),
        (MakeBEVMask, {"num_classes": -1}, "num_classes must be more than 0"),
        (MakePVMask, {"stride": 0}, "stride must be more than 0"),
        (MakePVMask, {"thickness_px": 0}, "thickness_px must be more than 0"),
    ],
)
def test_numbers_that_are_not_positive_are_refused_when_it_is_built(transform, settings, message):
    with pytest.raises(ValueError, match=message):
        transform(**settings)


def test_a_sample_without_targets_is_named():
    sample = {"token": "a", "map_instances": [], "x_range": (0.0, 9.0), "y_range": (0.0, 6.0)}
    with pytest.raises(ValueError, match="'a' has no targets yet: put MakeInstanceMasks behind"):
        MakeInstanceMasks().transform(sample)
