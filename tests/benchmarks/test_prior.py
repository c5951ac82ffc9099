from argparse import Namespace

import numpy as np
import pytest

from benchmarks import prior, prior_kinds
from gsmap.structures.elements import MapElements


def test_the_tables_have_a_row_of_figures_for_each_rule_and_for_gaussians(tmp_path):
    out = tmp_path / "prior.md"
    prior.run(Namespace(km=0.05, repeats=2, compared_km=0.05, out=out))
    rows = [line.split(" | ") for line in out.read_text().splitlines() if line.startswith("| ")]
    names = [row[0].removeprefix("| ") for row in rows]
    rules = ["KeepMaximum", "LastSeen", "HitMissCounts"]
    assert names == ["rule", "---", *rules, "prior", "---", *rules, "Gaussians"]
    for row in rows[2:5]:
        figures = [float(cell.removesuffix(" |")) for cell in row[1:]]
        assert all(figure > 0 for figure in figures)
    for row in rows[7:]:
        iou, threshold = map(float, row[4].split(" at "))
        assert 0.2 < iou <= 1
        assert 0.1 <= threshold <= 0.9
    assert 50 < int(rows[-1][5].removesuffix("% |")) <= 100


def test_frames_without_noise_are_the_truth(monkeypatch):
    """Lines are straight ahead at the start of the road."""
    monkeypatch.setattr(prior_kinds, "NOISE_M", 0.0)
    monkeypatch.setattr(prior_kinds, "MISSED", 0.0)
    monkeypatch.setattr(prior_kinds, "FALSE", 0.0)
    lines = prior_kinds.true_lines(100.0)
    pose = prior_kinds.pose_on_road(0.0, beside_m=0.0)
    truth = prior_kinds.elements_in_range(lines, pose)
    assert truth.labels.tolist() == [1, 0, 0, 0, 1]
    found = prior_kinds.predict(truth, np.random.default_rng(0))
    assert isinstance(found, MapElements)
    offsets = [float(np.interp(0.0, line[:, 1], line[:, 0])) for line in found.polylines]
    assert offsets == pytest.approx([-7.0, -3.5, 0.0, 3.5, 7.0], abs=0.02)
