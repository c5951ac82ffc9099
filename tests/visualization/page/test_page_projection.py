"""Lines over the cameras of the report page: what its script draws of rings and open lines."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

import gsmap.visualization.page.page as page_module

NODE = shutil.which("node")
pytestmark = pytest.mark.skipif(NODE is None, reason="no node (Debian: nodejs)")
SCRIPT = Path(page_module.__file__).with_name("page.js")
# A camera 1.5 m above the road that looks to the left: the depth of (right, ahead) is -right.
# It maps to (500 ahead, 400 right - 750) / right, shifted by its principal point (500, 400).
MATRIX = [-500, 500, 0, -400, 0, 750, -1, 0, 0]
CROSSING = [(-14.8, 2), (14.8, 2), (14.8, 6), (-14.8, 6)]  # (right, ahead) in metres
FRONT, BACK = "567.6 450.7", "702.7 450.7"  # pixels of the first and the last point


def drawn(points: list[tuple[float, float]], *, area: bool) -> list[list[str]]:
    """Paths that the page draws: the pixels of each.

    Args:
        points: Points (right, ahead) in metres.
        area: Whether the class is one of areas.
    """
    script = SCRIPT.read_text()
    constants = re.findall(r"^const \w+ = [\d.]+;", script, re.MULTILINE)
    (function,) = re.findall(r"^function projected\(.*?^}", script, re.MULTILINE | re.DOTALL)
    item = {"c": 0, "p": [round(100 * value) for point in points for value in point]}
    lines = [
        *constants,
        f"const data = {json.dumps({'classes': [{'area': area}]})};",
        function,
        f"console.log(projected({json.dumps(item)}, {json.dumps(MATRIX)}));",
    ]
    run = subprocess.run(
        [NODE, "-e", "\n".join(lines)], capture_output=True, text=True, check=True, timeout=60
    )
    return [path.split("L") for path in run.stdout.strip().split("M")[1:]]


@pytest.mark.parametrize("area", [True, False])
def test_an_open_line_has_its_edges_and_no_other(area):
    """The first and the last edge of the outline cross the plane of the camera."""
    first, last = drawn(CROSSING, area=area)
    assert first[0] == FRONT
    assert last[-1] == BACK
    assert (len(first), len(last)) == (2, 2)
    assert drawn(CROSSING[:2], area=area) == [first]
    assert drawn(CROSSING[::-1], area=area) == [last[::-1], first[::-1]]


@pytest.mark.parametrize("gap_m", [0.0, 0.05])
def test_a_ring_of_an_area_is_one_path(gap_m):
    """The edge between the last and the first point is visible, wherever the ring starts."""
    right, ahead = CROSSING[0]
    (path,) = drawn([*CROSSING, (right, ahead + gap_m)], area=True)
    assert FRONT in path
    assert path[1] == BACK
    assert len(path) == (4 if gap_m == 0 else 5)
    turned = [*CROSSING[2:], *CROSSING[:3]]  # starts behind the camera
    assert len(drawn(turned, area=True)) == 1


def test_a_ring_before_the_camera_is_not_changed():
    visible = [(-9, 2), (-5, 2), (-5, 6), (-9, 6), (-9, 2)]
    (path,) = drawn(visible, area=True)
    assert len(path) == 5
    assert path[0] == path[-1]
