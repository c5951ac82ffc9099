"""What an evaluation logs, through a runner of mmengine."""

import json

import pytest
import torch
from mmengine.evaluator import BaseMetric, Evaluator
from mmengine.runner import Runner

import gsmap.registered  # noqa: F401

MAIN = ["chamfer/mAP", "chamfer/divider/AP", "raster/line/AP", "raster/mAP", "mine/chamfer/mAP"]
DETAILS = ["chamfer/AP@0.5", "chamfer/divider/tp@0.5", "raster/divider/mIoU", "mine/raster/mIoU"]
OTHERS = ["seg/mIoU", "AP@0.5"]  # of another metric


class Figures(BaseMetric):
    """A metric whose figures are known."""

    default_prefix = ""

    def process(self, data_batch, data_samples):
        self.results.append(0)

    def compute_metrics(self, results):
        return dict.fromkeys([*MAIN, *DETAILS, *OTHERS], 0.25)


class Model(torch.nn.Module):
    """A model that predicts nothing."""

    def val_step(self, data):
        return [{}]


@pytest.mark.parametrize("hierarchy", [False, True])
def test_the_log_line_is_short_and_the_json_log_complete(hierarchy, tmp_path):
    processor = {"type": "MapLogProcessor", "log_with_hierarchy": hierarchy}
    runner = Runner(
        Model(),
        str(tmp_path),
        val_dataloader=torch.utils.data.DataLoader([0]),
        val_cfg={},
        val_evaluator=Evaluator(Figures()),
        log_processor=processor,
        experiment_name=f"figures-{hierarchy}",
        default_scope="mmdet3d",  # it outlives the runner
    )
    figures = runner.val()
    assert set(figures) == {*MAIN, *DETAILS, *OTHERS}
    (log,) = tmp_path.glob("*/*.log")
    (line,) = [line for line in log.read_text().splitlines() if "Epoch(val)" in line]
    prefix = "val/" if hierarchy else ""
    expected = [f"{prefix}{name}: 0.2500" for name in MAIN + OTHERS]
    assert line.split("  ")[1:-2] == expected
    assert [item.split(": ")[0] for item in line.split("  ")[-2:]] in (
        [f"{prefix}time", f"{prefix}data_time"],
        [f"{prefix}data_time", f"{prefix}time"],
    )
    (scalars,) = tmp_path.glob("*/vis_data/scalars.json")
    record = json.loads(scalars.read_text())
    assert {f"{prefix}{name}" for name in (*MAIN, *DETAILS, *OTHERS)} <= set(record)
