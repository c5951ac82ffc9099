"""What mmengine tells of itself: only to whoever debugs."""

import errno
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
import torch
from mmengine.config import Config
from mmengine.evaluator import Evaluator
from mmengine.evaluator.metric import DumpResults
from mmengine.hooks import Hook
from mmengine.runner import Runner
from torch.utils.data import ConcatDataset as TorchConcat

import gsmap.registered  # noqa: F401
from gsmap.engine.run_log import MapRunner, _describe_data, _missed_elements_warning


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


def run_with(counts, queries):
    """Return a runner whose training samples have so many elements, and its model."""
    annotations = SimpleNamespace(instance_counts=lambda: np.array(counts))
    loader = SimpleNamespace(dataset=SimpleNamespace(annotations=annotations))
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
        self.annotations = SimpleNamespace(instance_counts=lambda: np.array([1, width]))
        self._camera = SimpleNamespace(name="front", width=width, height=9)

    def __len__(self):
        return 2

    def sample(self, index):
        return SimpleNamespace(cameras=[self._camera])


def test_data_sets_inside_of_others_are_described():
    repeated = SimpleNamespace(dataset=Drives("b.arrow", 32))
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
