"""The reference's way and ours give the same AP, whatever OpenCV is installed."""

import numpy as np
import pytest

pytest.importorskip("pycocotools")

from benchmarks import reference_evaluation as reference
from benchmarks.evaluation import CLASSES
from gsmap.evaluation import ChamferConfig, MapEvaluator, RasterConfig
from gsmap.structures.elements import MapElements


def frames(seed: int, count: int = 40) -> list[reference.Frame]:
    """Crossings that are small stars and lines, with noisy predictions of each."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        lines, labels = [], rng.integers(0, 3, 6)
        for label in labels:
            angles = np.sort(rng.uniform(0, 2 * np.pi, 9)) if label == 1 else np.linspace(0, 1, 9)
            radii = rng.uniform(0.5, 4.0, 9) if label == 1 else np.linspace(-9, 9, 9)
            centre = rng.uniform((-12, -25), (12, 25))
            lines.append(centre + radii[:, None] * np.stack([np.cos(angles), np.sin(angles)], 1))
        noisy = [line + rng.normal(0, 0.25, line.shape) for line in lines]
        scores = rng.permutation(600)[:6] / 600
        truth = MapElements.from_polylines(lines, labels)
        found.append((MapElements.from_polylines(noisy, labels, scores), truth))
    return found


@pytest.mark.parametrize("seed", range(3))
def test_ap_raster_is_ours_where_polygons_are_those_of_the_released_figures(seed):
    samples, config = frames(seed), RasterConfig(CLASSES)
    evaluator = MapEvaluator(config)
    for predictions, truth in samples:
        evaluator.update(predictions, truth)
    ours = evaluator.compute()["raster/mAP"]
    assert reference.raster_map(samples, config, by_opencv=False) == pytest.approx(ours, abs=1e-9)
    if reference.FILLS_AS_RELEASED:
        assert reference.raster_map(samples, config) == pytest.approx(ours, abs=1e-9)


def test_ap_chamfer_is_ours():
    samples = frames(3)
    evaluator = MapEvaluator(ChamferConfig(CLASSES))
    for predictions, truth in samples:
        evaluator.update(predictions, truth)
    wanted = evaluator.compute()["chamfer/mAP"]
    assert reference.chamfer_map(samples, len(CLASSES)) == pytest.approx(wanted, abs=1e-6)
