"""The models that ship score what they should on towns that they have not seen."""

import json
from pathlib import Path

import pytest
from processes import run_tool

from mapdata.nuscenes.convert import NuScenesOptions, convert_nuscenes
from minicity.generate import generate

# mAP_chamfer, mAP_raster of these 12 samples; those of 400 are in models/README.md
FIGURES = {"gsmap_r18_minicity": (0.4223, 0.1886), "maptr_r18_minicity": (0.4426, 0.2041)}


@pytest.fixture(scope="module")
def towns(tmp_path_factory) -> Path:
    """Three validation scenes of four samples, sized as those that the models were trained on."""
    root = tmp_path_factory.mktemp("towns") / "root"
    generate(root, 4, 0, (400, 225), samples_per_scene=4, val_scenes=3, workers=1)
    convert_nuscenes(NuScenesOptions(root, "v1.0-trainval", dataset="minicity"))
    return root


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gsmap_r18_minicity", "maptr_r18_minicity"])
def test_a_shipped_model_scores_its_figures(name, towns, tmp_path):
    """Measured once, of the same seed; floats of another machine may tip a pair or two."""
    metrics = tmp_path / "metrics.json"
    words = "--work-dir", tmp_path, "--metrics-out", metrics, "--data-root", towns
    done = run_tool("tools/test.py", name, *words)
    assert done.returncode == 0, done.stderr[-3000:]
    figures = json.loads(metrics.read_text())
    found = (figures["chamfer/mAP"], figures["raster/mAP"])
    assert found == pytest.approx(FIGURES[name], abs=0.02)
