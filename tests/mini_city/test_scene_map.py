"""Painted lines and crossings."""

import numpy as np
import pytest
from shapely.geometry import Polygon

from minicity.scene_map import dashed_line, double_line, solid_line, zebra


def test_marking_shapes_worked_by_hand() -> None:
    line = np.array([[0.0, 0.0], [10.0, 0.0]])
    (solid,) = solid_line(line, 0.2)
    assert Polygon(solid).area == pytest.approx(2.0)
    dashes = [Polygon(d) for d in dashed_line(line, 0.2, 3.0, 3.0)]
    assert [d.bounds[0] for d in dashes] == pytest.approx([0.0, 6.0])
    assert [d.bounds[2] for d in dashes] == pytest.approx([3.0, 9.0])
    left, right = (Polygon(d) for d in double_line(line, 0.1, 0.2))
    assert (left.bounds[1], left.bounds[3]) == pytest.approx((0.1, 0.2))
    assert (right.bounds[1], right.bounds[3]) == pytest.approx((-0.2, -0.1))
    stripes = [Polygon(s) for s in zebra(line, line + np.array([0.0, 3.0]))]
    assert len(stripes) == 9
    assert sum(s.area for s in stripes) == pytest.approx(9 * 0.5 * 3.0)
