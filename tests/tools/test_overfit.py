"""GSMap learns: the demo's model on one sample, with the configuration of the four-sample run."""

import json

import pytest
from mmengine.config import Config
from processes import run_tool

from gsmap.engine.launch import read_config
from gsmap.engine.overfitting import LOG_LINES, overfit

ITERATIONS = 150


def test_the_demos_model_learns_one_sample_by_heart(
    minicity_root, minicity_annotations, tmp_path
) -> None:
    """Points, masks and the score of its two boundaries; its third element takes longer."""
    options = []
    for part in ("train", "val"):
        options += [f"{part}_dataloader.{key}" for key in ("dataset.indices=1", "num_workers=0")]
        options.append(f"{part}_dataloader.persistent_workers=False")
    words = [
        *("tools/train.py", "projects/GSMap/configs/gsmap_maptr_r18_overfit.py"),
        *("--work-dir", tmp_path, "--data-root", minicity_root),
        *("--cfg-options", *options),
        *("randomness.seed=0", "train_dataloader.batch_size=1", "optim_wrapper.optimizer.lr=2e-3"),
        *(f"train_cfg.max_epochs={ITERATIONS}", f"train_cfg.val_interval={ITERATIONS // 3}"),
        "default_hooks.checkpoint.interval=1000",
    ]
    done = run_tool(*words)
    assert done.returncode == 0, done.stderr[-3000:]
    (scalars,) = tmp_path.glob("*/vis_data/scalars.json")
    records = [json.loads(line) for line in scalars.read_text().splitlines()]
    losses = [record for record in records if "loss" in record]
    assert losses[-1]["loss_pts"] < 0.1 * losses[0]["loss_pts"]
    assert losses[-1]["loss_raster"] < 0.5 * losses[0]["loss_raster"]
    scores = [record for record in records if "chamfer/mAP" in record]
    assert scores[-1]["chamfer/boundary/num_gts"] == 2
    assert scores[-1]["chamfer/boundary/AP"] > 0.9 > scores[0]["chamfer/boundary/AP"]


def test_the_option_learns_one_sample_with_a_short_log_and_no_validation(tiny_config, tmp_path):
    words = ["tools/train.py", tiny_config, "--work-dir", tmp_path, "--overfit", 1]
    done = run_tool(*words, "--overfit-iterations", 60)
    assert done.returncode == 0, done.stderr[-3000:]
    (log,) = (path.read_text() for path in tmp_path.glob("*/*.log"))
    assert "training    1 sample of" in log
    assert "60 iterations, 1 sample x 1 process each; no validation" in log
    assert len(log.splitlines()) < 3 * LOG_LINES
    (scalars,) = tmp_path.glob("*/vis_data/scalars.json")
    records = [json.loads(line) for line in scalars.read_text().splitlines()]
    assert len(records) <= LOG_LINES + 1
    assert records[-1]["loss"] < 0.8 * records[0]["loss"]
    assert [path.name for path in tmp_path.glob("*.pth")] == ["iter_60.pth"]


@pytest.mark.parametrize(
    ("samples", "iterations", "changes", "message"),
    [
        (0, 300, {}, "--overfit must be >= 1, got 0"),
        (1, -5, {}, "--overfit-iterations must be >= 1, got -5"),
        (1, 300, {"dataset": {"type": "RepeatDataset", "dataset": {}}}, "is a RepeatDataset of"),
        (1, 300, {"sampler": {"type": "StreamTrainSampler"}}, "is a StreamTrainSampler: take"),
    ],
)
def test_the_option_refuses_bad_numbers_and_wrapped_data(samples, iterations, changes, message):
    loader = {"dataset": {"type": "VectorizedMapDataset"}, "sampler": {"type": "DefaultSampler"}}
    cfg = Config({"train_dataloader": {**loader, **changes}})
    with pytest.raises(ValueError, match=message):
        overfit(cfg, samples, iterations)


def test_a_model_with_a_memory_is_refused():
    with pytest.raises(ValueError, match=r"the memory of the model of .*hrmapnet.* would be empty"):
        overfit(read_config("hrmapnet_r18_minicity"), 1, 300)
