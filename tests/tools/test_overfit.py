"""GSMap learns: the demo's model on one sample, with the configuration of the four-sample run."""

import json

from processes import run_tool

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
