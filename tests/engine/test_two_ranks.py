"""Two processes: figures without a shared folder, a NaN loss of one, batch statistics of EMA."""

import json
import os
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from mmengine.hooks import EMAHook
from mmengine.model import ExponentialMovingAverage
from torch import nn

from gsmap.engine.optimizers import MapOptimWrapper
from gsmap.engine.sync_buffers import MapSyncBuffersHook
from gsmap.evaluation.map_metric import MapMetric
from gsmap.utils.cli import end_process


def _score(rank: int, folder: Path) -> float:
    """AP of one sample per rank, each in a working folder of its own."""
    own = folder / f"machine{rank}"
    own.mkdir()
    os.chdir(own)
    metric = MapMetric(eval=["chamfer"])
    metric.dataset_meta = {"classes": ["divider"], "dim": 2}
    line = torch.tensor([[[0.0, 0.0], [0.0, 5.0]]])
    found = {"scores_3d": torch.tensor([0.9]), "labels_3d": torch.tensor([0]), "pts": line}
    truth = {"labels": torch.tensor([0]).numpy(), "polylines": [line[0].numpy() + 9 * rank]}
    sample = {"token": f"t{rank}", "pred_instances_3d": found, "eval_ann_info": truth}
    metric.process(None, [sample])
    figures = metric.evaluate(2)
    assert not list(own.iterdir())
    return figures["chamfer/mAP"]


def _step_after_nan(rank: int) -> list[float]:
    """Weights after a step with a loss that is NaN on rank 1, flagged as on a GPU."""
    model = nn.parallel.DistributedDataParallel(nn.Linear(2, 1))
    nn.init.ones_(model.module.weight)
    wrapper = MapOptimWrapper(torch.optim.AdamW(model.parameters(), lr=0.1, fused=True))
    loss = model(torch.ones(1, 2)).sum() * (float("nan") if rank == 1 else 1.0)
    wrapper._has_nonfinite_loss = loss.detach().isfinite().logical_not().float()
    wrapper.update_params(loss)
    return model.module.weight[0].tolist()


def _averaged_statistics(rank: int) -> list[list[float]]:
    """Running means of a model and of its EMA after an epoch on other data."""
    model = nn.BatchNorm1d(1, momentum=1.0)
    hook = EMAHook()
    hook.ema_model = ExponentialMovingAverage(model)
    model(torch.full((2, 1), 2.0 + 4.0 * rank))
    hook.ema_model.update_parameters(model)
    runner = SimpleNamespace(model=model, hooks=[hook])
    MapSyncBuffersHook().after_train_epoch(runner)
    return [model.running_mean.tolist(), hook.ema_model.module.running_mean.tolist()]


def _work(rank: int, folder: str) -> None:
    torch.distributed.init_process_group(
        "gloo",
        init_method=f"file://{folder}/rendezvous",
        rank=rank,
        world_size=2,
        timeout=timedelta(minutes=5),
    )
    found = {
        "AP": _score(rank, Path(folder)),
        "weights": _step_after_nan(rank),
        "statistics": _averaged_statistics(rank),
    }
    Path(folder, f"{rank}.json").write_text(json.dumps(found))
    torch.distributed.barrier()
    end_process(0)  # before DistributedDataParallel deletes the process group


@pytest.mark.slow
def test_two_ranks_have_one_result(tmp_path):
    torch.multiprocessing.spawn(_work, (str(tmp_path),), nprocs=2)
    first, second = (json.loads((tmp_path / f"{rank}.json").read_text()) for rank in range(2))
    assert first == second
    assert first["AP"] == pytest.approx(0.5)  # one of the two elements is found
    assert first["weights"] == [1.0, 1.0]
    assert first["statistics"] == [[4.0], [4.0]]
