"""What mmengine tells of itself: only to whoever debugs."""

import errno
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
import torch
from mmdet3d.datasets import CBGSDataset
from mmengine.config import Config
from mmengine.dataset import ClassBalancedDataset, ConcatDataset, RepeatDataset
from mmengine.evaluator import Evaluator
from mmengine.evaluator.metric import DumpResults
from mmengine.hooks import Hook
from mmengine.optim import OptimWrapper, OptimWrapperDict
from mmengine.runner import Runner
from torch.utils.data import ConcatDataset as TorchConcat
from torch.utils.data import Subset

import gsmap.registered  # noqa: F401
from gsmap.datasets.vectorized_map_dataset import VectorizedMapDataset
from gsmap.engine.run_log import (
    MapRunner,
    _describe_data,
    _element_counts,
    _missed_elements_warning,
)


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


@pytest.mark.parametrize("kind", ["link", "input", "earlier"])
def test_the_config_of_a_run_replaces_no_other_file(kind, tmp_path):
    source, keys, work = tmp_path / "mine.py", tmp_path / "keys", tmp_path / "run"
    source.write_text("a = 1  # my notes\n")
    keys.write_text("mine")
    work.mkdir()
    if kind == "link":
        (work / "mine.py").symlink_to(keys)
    elif kind == "earlier":
        (work / "mine.py").write_text("a = 0\n")
    cfg = Config.fromfile(source)
    MapRunner(
        torch.nn.Linear(1, 1),
        str(tmp_path if kind == "input" else work),
        experiment_name=f"dumped-{kind}",
        default_scope="mmdet3d",
        cfg=cfg,
    )
    assert keys.read_text() == "mine"
    assert source.read_text() == "a = 1  # my notes\n"
    assert (work / "mine.py").exists() == (kind != "input")
    assert kind == "input" or Config.fromfile(work / "mine.py").to_dict() == {"a": 1}


@pytest.mark.parametrize(
    ("counts", "base_batch_size", "enable", "rate"),
    [(1, 8, True, 0.5), (4, 8, True, 2.0), (3, 8, True, 1.5), (4, 8, False, 1.0)],
)
@pytest.mark.parametrize("several", [False, True])
def test_the_rate_is_scaled_to_the_samples_of_an_optimizer_step(
    counts, base_batch_size, enable, rate, several, tmp_path
):
    """Batches of 4 samples; accumulated gradients have those of several batches."""
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.ones(1))], lr=1.0)
    wrapper = OptimWrapper(optimizer, accumulative_counts=counts)
    single = OptimWrapper(torch.optim.SGD([torch.nn.Parameter(torch.ones(1))], lr=1.0))
    runner = MapRunner(
        torch.nn.Linear(1, 1),
        str(tmp_path),
        train_dataloader=torch.utils.data.DataLoader([0] * 8, batch_size=4),
        train_cfg={"by_epoch": True, "max_epochs": 1},
        optim_wrapper=wrapper,
        experiment_name=f"rate-{counts}-{enable}-{several}",
        default_scope="mmdet3d",
    )
    settings = {"enable": enable, "base_batch_size": base_batch_size}
    wrappers = OptimWrapperDict(a=wrapper, b=single) if several else wrapper
    runner.scale_lr(wrappers, settings)
    assert optimizer.param_groups[0]["lr"] == rate
    unscaled = not (several and enable)
    assert single.optimizer.param_groups[0]["lr"] == (1.0 if unscaled else 0.5)
    assert settings == {"enable": enable, "base_batch_size": base_batch_size}  # unchanged
    runner.scale_lr(wrapper)  # without settings
    assert optimizer.param_groups[0]["lr"] == rate


def run_with(counts, queries):
    """Return a runner whose training samples have so many elements, and its model."""
    dataset = SimpleNamespace(instance_counts=lambda: np.array(counts))
    loader = SimpleNamespace(dataset=dataset)
    head = SimpleNamespace(query_groups=[SimpleNamespace(num=queries)])
    return SimpleNamespace(train_dataloader=loader), SimpleNamespace(map_head=head)


def test_elements_that_no_query_is_left_for_are_counted():
    text = _missed_elements_warning(*run_with([3, 43, 21, -1], 20))
    assert text.startswith(
        "2 of 4 training samples have more elements (up to 43) than the model has queries (20): "
        "24 elements can never be found."
    )
    assert _missed_elements_warning(*run_with([3, 20, -1], 20)) is None


class Drives:
    """A data set of samples with one camera and one map element each."""

    cameras = None
    metainfo: ClassVar = {"x_range": (-1, 1), "y_range": (-2, 2), "classes": ("divider",)}

    def __init__(self, ann_file, width):
        self.ann_file = ann_file
        self._camera = SimpleNamespace(name="front", width=width, height=9)

    def __len__(self):
        return 2

    def sample(self, index):
        return SimpleNamespace(cameras=[self._camera])

    def instance_counts(self):
        return np.array([1, self._camera.width])


def test_data_sets_inside_of_others_are_described():
    repeated = Subset(Drives("b.arrow", 32), [1])
    train = TorchConcat([Drives("a.arrow", 16), TorchConcat([Drives("a.arrow", 16)])])
    train.datasets.append(repeated)
    runner, model = run_with([], 20)
    runner.train_dataloader.dataset = train
    runner.val_loop = True
    runner.val_dataloader = SimpleNamespace(dataset=Drives("c.arrow", 64))
    lines = _describe_data(runner)
    assert lines["training"] == "4 samples of a.arrow, b.arrow"
    assert lines["validation"] == "2 samples of c.arrow"
    assert lines["cameras"] == "1, their files 16 x 9 and 32 x 9 and 64 x 9"
    assert lines["elements"] == "up to 32 in a sample"
    assert "12 elements can never be found" in _missed_elements_warning(runner, model)


def test_only_elements_of_samples_in_use_are_counted(minicity_annotations):
    """Wrappers repeat samples or leave them out."""
    dataset = VectorizedMapDataset(minicity_annotations["train"])
    counts = dataset.annotations.instance_counts().tolist()
    part = dataset.get_subset([1])
    balanced = ClassBalancedDataset(dataset, oversample_thr=1e-3)
    balanced.repeat_indices = [0, 1, 1]
    resampled = CBGSDataset(dataset, lazy_init=True)
    resampled.sample_indices = [1, 1]
    resampled._fully_initialized = True
    for used, expected in (
        (part, counts[1:]),
        (Subset(dataset, [1]), counts[1:]),
        (RepeatDataset(part, times=2), counts[1:] * 2),
        (Subset(RepeatDataset(dataset, times=2), [3]), counts[1:]),
        (balanced, [*counts, counts[1]]),
        (resampled, [counts[1], counts[1]]),
        (ConcatDataset([part, dataset]), [counts[1], *counts]),
    ):
        assert _element_counts(used).tolist() == expected


@pytest.mark.parametrize("loop", ["train", "test"])
def test_a_full_disk_is_named_by_the_folder_of_the_run(loop, tmp_path, monkeypatch):
    """mmengine's writers say no file."""

    def full(_runner):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Runner, loop, full)
    runner = MapRunner.__new__(MapRunner)
    runner._work_dir, runner._world_size = str(tmp_path), 1
    with pytest.raises(OSError, match="No space left") as caught:
        getattr(runner, loop)()
    assert caught.value.filename == str(tmp_path)
