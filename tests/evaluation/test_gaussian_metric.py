import logging
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from mmengine.logging import HistoryBuffer

from gsmap.engine.gaussian_health_hook import GaussianHealthHook
from gsmap.evaluation.gaussian_metric import GaussianMetric

CLASSES = ("divider", "ped_crossing")


def lane(x, scales, score=0.9, label=0):
    """20 Gaussians 2 m apart along y, whose first axis lies along it."""
    y = torch.linspace(-19, 19, 20)
    return {
        "scores_3d": torch.tensor([score]),
        "labels_3d": torch.tensor([label]),
        "pts": torch.stack([torch.full_like(y, x), y], -1)[None],
        "scales": torch.tensor(scales).expand(1, 20, 2),
        "rotations": torch.full((1, 20), np.pi / 2),
        "min_scale_m": 0.15,
    }


def evaluate(predicted, xs=(0.0,), x_range=(-15, 15), y_range=(-30, 30)):
    metric = GaussianMetric()
    metric.dataset_meta = {"classes": CLASSES}
    lines = [np.array([[x, -20.0], [x, 20.0]]) for x in xs]
    sample = {
        "token": "a",
        "x_range": x_range,
        "y_range": y_range,
        "pred_instances_3d": predicted,
        "eval_ann_info": {"polylines": lines, "labels": np.zeros(len(lines), int)},
    }
    metric.process(None, [sample])
    return metric.evaluate(1)


def test_gaussians_along_their_line_overlap_it_and_have_their_sizes():
    figures = evaluate(lane(0.0, (1.0, 0.3)))
    assert figures["gaussians/soft_iou/divider"] > 0.6
    assert figures["gaussians/sigma_along/divider"] == pytest.approx(1.0)
    assert figures["gaussians/sigma_across/divider"] == pytest.approx(0.3)
    assert figures["gaussians/at_floor"] == 0
    assert "gaussians/soft_iou/ped_crossing" not in figures


def test_dots_are_seen_as_dots():
    figures = evaluate(lane(0.0, (0.16, 0.15)))
    assert figures["gaussians/at_floor"] == 1
    assert figures["gaussians/soft_iou/divider"] < 0.2


def test_predictions_go_to_the_ground_truth_that_they_overlap():
    assert evaluate(lane(5.0, (1.0, 0.3)), xs=(-5.0, 5.0))["gaussians/soft_iou/divider"] > 0.6
    assert evaluate(lane(0.0, (1.0, 0.3)), xs=(-5.0,))["gaussians/soft_iou/divider"] == 0


def test_improbable_predictions_and_models_without_gaussians_have_no_figures():
    assert "gaussians/soft_iou/divider" not in evaluate(lane(0.0, (1.0, 0.3), score=0.1))
    points = lane(0.0, (1.0, 0.3))
    assert evaluate({name: points[name] for name in ("scores_3d", "labels_3d", "pts")}) == {}


@pytest.mark.parametrize(("share", "warnings"), [(0.9, 1), (0.2, 0), (None, 0)])
def test_a_run_whose_gaussians_die_says_so(share, warnings, caplog):
    scalars = {} if share is None else {"train/at_floor": HistoryBuffer([share] * 60, [1] * 60)}
    hub = SimpleNamespace(log_scalars=scalars)
    runner = SimpleNamespace(message_hub=hub, logger=logging.getLogger("run"))
    GaussianHealthHook().after_train_epoch(runner)
    assert len(caplog.records) == warnings
    if warnings:
        assert "90 % of the Gaussians" in caplog.text
        assert "normalize='both'" in caplog.text


def test_pixels_need_not_divide_the_map():
    figures = evaluate(lane(0.0, (1.0, 0.3)), x_range=(-25, 25), y_range=(-50, 50))
    assert figures["gaussians/soft_iou/divider"] > 0.6
