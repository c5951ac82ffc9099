"""The blocks of docs/library.md run, one after the other, and do what the page says."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

PAGE = Path(__file__).resolve().parents[1] / "docs/library.md"


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> dict:
    """All values that the page's blocks leave, and the folder that they ran in."""
    folder, scope = tmp_path_factory.mktemp("library"), {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for block in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL):
            exec(block, scope)
    return {**scope, "folder": folder}


def test_the_metric_scores_arrays(ran):
    assert ran["report"].name == "raster"
    aps = [ran["figures"][f"{name}/divider/AP"] for name in ("chamfer", "raster")]
    assert aps == pytest.approx([1.0, 0.9], abs=0.11)
    for report in ran["evaluator"].reports(ran["matches"]):
        assert report.metrics.items() <= ran["figures"].items()


def test_the_loss_moves_gaussians_onto_the_line(ran):
    assert ran["losses"][-1] < 0.1 * ran["losses"][0]
    x, y = ran["means"][0].detach().unbind(-1)
    on_line = 2 * (y + 20) / 40
    assert float((x - on_line).abs().max()) < 0.3


def test_a_model_sees_images_in_memory(ran):
    assert ran["list_models"]()[:2] == ["gsmap_r18_minicity", "maptr_r18_minicity"]
    assert not ran["model"].training
    assert len(ran["elements"]) > 0
    assert ran["elements"].has_gaussians
    assert (ran["folder"] / "sample.png").stat().st_size > 10_000


def test_the_map_lies_where_the_vehicle_is(ran):
    found = json.loads((ran["folder"] / "map.geojson").read_text())["features"]
    assert len(found) == len(ran["best"]) > 0
    centre = np.mean(
        [p for f in found for p in np.reshape(f["geometry"]["coordinates"], (-1, 2))], 0
    )
    # 120 m east and 45 m north of the origin, within the map's 30 m
    degrees = 360 / 40_030_000
    east, north = (centre - (11.67, 48.26)) / degrees * (np.cos(np.radians(48.26)), 1)
    assert np.hypot(east - 120, north - 45) < 30
