"""What mmengine tells of itself: only to whoever debugs."""

import pytest
import torch
from mmengine.evaluator import Evaluator
from mmengine.evaluator.metric import DumpResults
from mmengine.hooks import Hook

import gsmap.registered  # noqa: F401
from gsmap.engine.run_log import MapRunner


@pytest.mark.parametrize("level", ["INFO", "DEBUG"])
def test_dumps_are_told_to_whoever_debugs(level, tmp_path):
    runner = MapRunner(
        torch.nn.Linear(1, 1),
        str(tmp_path),
        val_dataloader=torch.utils.data.DataLoader([0]),
        val_cfg={},
        val_evaluator=Evaluator(DumpResults(str(tmp_path / "out.pkl"))),
        custom_hooks=[Hook()],
        log_level=level,
        experiment_name=f"dumps-{level}",
        default_scope="mmdet3d",
        cfg={"riddle": 1},
    )
    runner.logger.info("what matters")
    text = next(tmp_path.glob("*/*.log")).read_text()
    assert "what matters" in text
    for dump in ("System environment", "riddle", "Hooks will be executed"):
        assert (dump in text) == (level == "DEBUG")
