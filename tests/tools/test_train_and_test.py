"""The command-line tools, as a user runs them: train, be killed, resume, two processes, test."""

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from mmengine.config import Config
from mmengine.runner import FlexibleRunner
from processes import free_port, run_tool, search_path, wait_for
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from waiting import waiting_config

from gsmap.checkpoints.reading import read_checked
from gsmap.checkpoints.settings import MODEL_SETTINGS, plain
from gsmap.engine.launch import read_config
from gsmap.engine.run_log import MapRunner
from tools import test as test_tool
from tools.train import choose_start
from tools.train import main as train

pytestmark = pytest.mark.faults

REPO = Path(__file__).resolve().parents[2]
DIST_TRAIN = "tools/dist_train.sh"


def environment() -> dict[str, str]:
    own = {"OMP_NUM_THREADS": "1", "PYTHON": sys.executable, "PORT": str(free_port())}
    return {**os.environ, **own, **search_path()}


def run(*command: object) -> str:
    """Run a command to its end and return what it printed."""
    done = subprocess.run(
        [str(part) for part in command], cwd=REPO, env=environment(), text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-3000:]
    return done.stdout


def use(*words: object) -> str:
    """Run a tool in a fork of this process to its end and return what it printed."""
    done = run_tool(*words)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return done.stdout


@pytest.fixture(scope="module")
def trained(tiny_config, tmp_path_factory) -> Path:
    """The work folder of a run that was killed with SIGKILL after its first epoch, then resumed."""
    work = tmp_path_factory.mktemp("work")
    leaf, waits = waiting_config(tiny_config, tmp_path_factory.mktemp("leaf"))
    command = ["tools/train.py", str(leaf), "--work-dir", str(work), "--resume"]
    with subprocess.Popen(
        [sys.executable, *command], cwd=REPO, env=environment(), text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    ) as training:  # fmt: skip
        wait_for(work / "last_checkpoint", training)
        training.send_signal(signal.SIGKILL)
    assert training.returncode == -signal.SIGKILL
    waits.unlink()
    (work / "killed_after").write_text(Path((work / "last_checkpoint").read_text()).name)
    (work / "resumed.log").write_text(use(*command))
    return work


def test_a_killed_training_goes_on_where_it_stopped(trained):
    log = (trained / "resumed.log").read_text()
    killed_after = (trained / "killed_after").read_text()
    assert f"{killed_after}" in log
    first = int(killed_after.removeprefix("epoch_").removesuffix(".pth")) + 1
    epochs = [n for n in (1, 2, 3) if f"Epoch(train)  [{n}]" in log or f"Epoch(train) [{n}]" in log]
    assert epochs == list(range(first, 4))
    assert read_checked(trained / "epoch_3.pth").image_size == (160, 90)  # 0.4 of 400 x 225
    assert not list(trained.glob("*partial"))  # nothing half-written is left


@pytest.mark.parametrize(
    ("resume", "load_from", "option", "wanted"),
    [
        (True, None, None, "work/epoch_2.pth"),
        (True, "other/epoch_1.pth", None, "other/epoch_1.pth"),
        (True, "other/epoch_1.pth", "auto", "work/epoch_2.pth"),
        (False, "other/epoch_1.pth", None, "other/epoch_1.pth"),
    ],
)
def test_the_config_may_ask_for_resumption(resume, load_from, option, wanted, tmp_path):
    for name in ("other/epoch_1.pth", "work/epoch_2.pth"):
        (tmp_path / name).parent.mkdir()
        torch.save({"state_dict": {"w": torch.ones(1)}}, tmp_path / name)
    source = load_from and str(tmp_path / load_from)
    cfg = Config({"work_dir": str(tmp_path / "work"), "resume": resume, "load_from": source})
    choose_start(cfg, option)
    assert (cfg.resume, cfg.load_from) == (resume, str(tmp_path / wanted))


def test_training_shows_pictures_on_tensorboard(trained):
    tags = set()
    for file in trained.glob("*/vis_data/events.*"):
        tags.update(EventAccumulator(str(file)).Reload().Tags()["images"])
    assert tags
    assert all(tag.startswith("val_") for tag in tags)


def test_the_log_opens_with_what_matters(trained):
    lines = (trained / "resumed.log").read_text().splitlines()
    first = next(i for i, line in enumerate(lines) if "Epoch(train)" in line)
    assert first < 20, lines[:first]
    opening = dict(line.split(maxsplit=1) for line in lines[:first] if line.startswith("    "))
    assert opening["model"].startswith("MapDetector with GSMapHead, 0.")
    assert opening["start"].startswith("goes on after iteration ")
    assert opening["cameras"] == "6, their files 400 x 225"
    assert opening["length"].startswith("3 epochs of 2 iterations, 1 sample x 1 process each")
    names = re.findall(r"  ([\w.]+): ", lines[first])
    assert names[:5] == ["lr", "eta", "time", "grad_norm", "loss"]
    assert {"loss_cls", "loss_pts", "loss_raster"} <= set(names)
    assert len(names) <= 10
    logs = [log.read_text() for log in trained.glob("*/*.log")]
    assert len(logs) == 2
    assert not any("Name of parameter" in log for log in logs)
    assert "val_interval=9" in (trained / "tiny.py").read_text()  # the whole config stands there


def test_one_and_two_processes_score_and_write_the_same(tiny_config, trained, tmp_path):
    metrics = ["--eval", "chamfer", "raster"]
    options = ["--work-dir", tmp_path / "work"]
    one, two = tmp_path / "one", tmp_path / "two"
    for folder in (one, two):
        folder.mkdir()
    use(
        "tools/test.py", tiny_config, trained / "epoch_3.pth", *metrics, *options,
        "--metrics-out", one / "metrics.json", "--out", one / "results.json",
        "--show-dir", one / "pictures",
    )  # fmt: skip
    run(
        "tools/dist_test.sh", tiny_config, trained / "epoch_3.pth", 2, *metrics, *options,
        "--metrics-out", two / "metrics.json", "--out", two / "results.json",
    )  # fmt: skip
    assert json.loads((one / "metrics.json").read_text()) == json.loads(
        (two / "metrics.json").read_text()
    )
    results = json.loads((one / "results.json").read_text())
    assert results == json.loads((two / "results.json").read_text())
    assert len(results["results"]) == 2
    assert len(list((one / "pictures").iterdir())) == 2


def test_the_data_set_and_what_a_model_finds_are_drawn(
    tiny_config, trained, minicity_root, tmp_path
):
    browsed, found = tmp_path / "browsed", tmp_path / "found"
    use(
        "tools/browse_dataset.py", tiny_config, "--num", "1", "--show-dir", browsed,
        "--format", "png",
    )  # fmt: skip
    use(
        "tools/infer.py", minicity_root / "gsmap_minicity_val.arrow", "--model",
        tiny_config, trained / "epoch_3.pth", "--max-samples", "1", "--order",
        "--show-dir", found, "--out", tmp_path / "map.json",
        "--cfg-options", "visualizer.width_px=400",
    )  # fmt: skip
    (result,) = json.loads((tmp_path / "map.json").read_text())["results"]
    (picture,) = found.iterdir()
    assert (
        re.fullmatch(r"[\w-]+_\d{4}\.\d\ds_(\w{8})\.png", picture.name)[1]
        == (result["sample_token"][-8:])
    )
    assert len(list(browsed.glob("*.png"))) == 1


def test_a_data_set_is_browsed_as_a_page(tiny_config, tmp_path):
    page = tmp_path / "page.html"
    done = use(
        "tools/browse_dataset.py", tiny_config, "--num", "1", "--split", "val", "--web", page
    )
    assert done.splitlines()[-1].startswith("1 frame, ")
    assert "<title>minicity val: ground truth</title>" in page.read_text()


WITHOUT_CHANCE = """
_base_ = '{config}'
model = dict(
    img_backbone=dict(norm_eval=True),
    img_neck=dict(norm_cfg=dict(type='GN', num_groups=2)))
train_dataloader = dict(batch_size={batch_size})
train_cfg = dict(max_epochs=2)
optim_wrapper = dict(optimizer=dict(_delete_=True, type='SGD', lr=1e-4))
randomness = dict(seed=0)
"""


def test_two_processes_learn_what_one_learns_from_the_same_batch(tiny_config, tmp_path):
    weights = []
    for ranks in (1, 2):
        work = tmp_path / str(ranks)
        leaf = tmp_path / f"ranks_{ranks}.py"
        leaf.write_text(WITHOUT_CHANCE.format(config=tiny_config, batch_size=2 // ranks))
        words = leaf, "--work-dir", work
        log = use("tools/train.py", *words) if ranks == 1 else run(DIST_TRAIN, leaf, 2, *words[1:])
        assert ("1 sample x 2 processes each", "2 samples x 1 process each")[ranks == 1] in log
        assert "[2][1/1]" in log.replace(" ", "")  # both samples in one iteration
        weights.append(torch.load(work / "epoch_2.pth", weights_only=False)["state_dict"])
    first = torch.load(tmp_path / "1" / "epoch_1.pth", weights_only=False)["state_dict"]
    moved = [(weights[0][name] - value).abs().max() for name, value in first.items()]
    assert max(moved) > 1e-4
    for name, value in weights[0].items():
        torch.testing.assert_close(weights[1][name], value, rtol=0, atol=1e-6, msg=name)


def test_a_cpu_trains_in_bfloat16_and_each_run_of_a_process_writes_its_own_curves(
    tiny_config, tmp_path, monkeypatch
):
    types = set()
    forward = torch.nn.Linear.forward

    def noted(self, x):
        result = forward(self, x)
        types.add(result.dtype)
        return result

    monkeypatch.setattr(torch.nn.Linear, "forward", noted)
    logs = []
    for work, amp, used in (("full", [], torch.float32), ("half", ["--amp"], torch.bfloat16)):
        types.clear()
        args = ["train.py", str(tiny_config), "--work-dir", str(tmp_path / work), *amp]
        monkeypatch.setattr("sys.argv", [*args, "--cfg-options", "train_cfg.max_epochs=1"])
        train()
        assert used in types
        (curves,) = (tmp_path / work).glob("*/vis_data/scalars.json")
        logs.append(json.loads(curves.read_text().splitlines()[0]))
    full, half = logs
    assert half["step"] == full["step"] == 1
    assert half["loss"] == pytest.approx(full["loss"], rel=0.01)
    assert half["loss"] != full["loss"]
    saved = read_checked(tmp_path / "half/epoch_1.pth").state
    assert torch.bfloat16 not in {weight.dtype for weight in saved.values()}


def test_the_config_chooses_the_runner(tiny_config, tmp_path, monkeypatch):
    built = []
    monkeypatch.setattr(FlexibleRunner, "train", lambda runner: built.append(runner))
    words = ["train.py", str(tiny_config), "--work-dir", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", [*words, "--cfg-options", "runner_type=FlexibleRunner"])
    train()
    assert [type(runner) for runner in built] == [FlexibleRunner]


@pytest.mark.parametrize("runner_type", [None, "FlexibleRunner"])
def test_a_scaled_rate_counts_accumulated_gradients(
    runner_type, tiny_config, tmp_path, monkeypatch
):
    """The base batch size is 2, and an optimizer step has 4 batches of one sample."""
    rates = []

    def note(runner, optim_wrapper, auto_scale_lr=None):
        scale(runner, optim_wrapper, auto_scale_lr)
        rates.append(optim_wrapper.optimizer.param_groups[0]["lr"])
        raise InterruptedError("that is enough")

    scale = MapRunner.scale_lr
    monkeypatch.setattr(MapRunner, "scale_lr", note)
    words = ["train.py", str(tiny_config), "--work-dir", str(tmp_path), "--auto-scale-lr"]
    words += ["--cfg-options", "optim_wrapper.accumulative_counts=4"]
    words += [f"runner_type={runner_type}"] if runner_type else []
    monkeypatch.setattr(sys, "argv", words)
    if runner_type:
        with pytest.raises(
            ValueError, match=r"FlexibleRunner would not count .*_counts is 4: leav"
        ):
            train()
        assert not rates
        return
    with pytest.raises(InterruptedError):
        train()
    assert rates == [pytest.approx(2 * 6e-4)]


def test_a_checkpoint_of_other_classes_than_the_data_set_is_not_tested(tmp_path, monkeypatch):
    settings = plain(read_config("gsmap_r18_minicity").model)
    settings["classes"].reverse()
    path = tmp_path / "other.pth"
    meta = {MODEL_SETTINGS: json.dumps(settings)}
    torch.save({"state_dict": {"w": torch.ones(1)}, "meta": meta}, path)
    words = ["test.py", "gsmap_r18_minicity", str(path), "--work-dir", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(
        ValueError, match=r"model\.classes is .*, but test_dataloader\.dataset\.cla"
    ):
        test_tool.main()


def test_figures_of_a_users_metric_are_written(tmp_path, monkeypatch):
    figures = {"a": np.float32(0.5), "b": torch.tensor(3), "c": np.arange(2), "d": tmp_path}
    runner = SimpleNamespace(rank=0, test=lambda: figures, register_hook=lambda hook: None)
    runner.model = SimpleNamespace(bev_encoder=None)
    monkeypatch.setattr(MapRunner, "from_cfg", lambda _: runner)
    out = tmp_path / "metrics.json"
    monkeypatch.setattr(sys, "argv", ["test.py", "gsmap_r18_minicity", "--metrics-out", str(out)])
    test_tool.main()
    assert json.loads(out.read_text()) == {"a": 0.5, "b": 3, "c": [0, 1], "d": str(tmp_path)}


def test_a_missing_checkpoint_is_named(tiny_config):
    done = run_tool("tools/test.py", tiny_config, "nowhere.pth")
    assert done.returncode == 2
    names = [model["name"] for model in json.loads((REPO / "models/registry.json").read_text())]
    shipped = [name for name in names if (REPO / f"models/{name}.pth").is_file()]
    assert done.stderr == (
        "error: There is no checkpoint nowhere.pth, and no model of that name "
        f"(the shipped models are {', '.join(shipped)}).\n"
    )


SAME_BUFFERS = """
import torch
from mmengine.dist import all_gather
from mmengine.hooks import Hook
from mmengine.registry import HOOKS

@HOOKS.register_module()
class SameBuffers(Hook):
    priority = 'VERY_LOW'

    def after_train_epoch(self, runner):
        means = {name: all_gather(value) for name, value in runner.model.named_buffers()
                 if name.endswith('running_mean')}
        unequal = [name for name, both in means.items() if not torch.equal(*both)]
        runner.logger.info(f'{len(unequal)} of {len(means)} statistics differ')
"""


@pytest.mark.parametrize("synchronized", [True, False])
def test_ranks_validate_with_the_same_batch_norms(synchronized, tiny_config, tmp_path):
    without = "default_hooks = dict(sync_buffers=dict(type='IterTimerHook'))"
    (tmp_path / "same_buffers.py").write_text(SAME_BUFFERS)
    (tmp_path / "leaf.py").write_text(
        f"_base_ = '{tiny_config}'\ncustom_hooks = [dict(type='SameBuffers')]\n"
        "custom_imports = dict(imports=['gsmap.registered', 'same_buffers'])\n"
        f"train_cfg = dict(max_epochs=1)\n{without * (not synchronized)}"
    )
    code, lines = end(
        DIST_TRAIN, tmp_path / "leaf.py", 2, "--work-dir", tmp_path / "work",
        path=tmp_path,
    )  # fmt: skip
    assert code == 0, lines
    unequal, count = re.search(r"(\d+) of (\d+) statistics differ", "\n".join(lines)).groups()
    assert int(count) > 0
    assert int(unequal) == (0 if synchronized else int(count))


DIES = """
import os, signal
from mmengine.hooks import Hook
from mmengine.registry import HOOKS

@HOOKS.register_module()
class Dies(Hook):
    def before_train_iter(self, runner, batch_idx, data_batch=None):
        if runner.rank == 1:
            os.kill(os.getpid(), signal.SIGKILL)
"""

WAITS = """
import torch.distributed as dist
from gsmap.utils.cli import run_command
from gsmap.utils.errors import InputError

def command():
    dist.init_process_group("gloo")
    if dist.get_rank() == 1:
        raise InputError("sample 'a' is broken")
    dist.barrier()  # rank 0 waits for ever

run_command(command, clean_up_on_kill=False)
"""


def end(*command: object, path: Path) -> tuple[int, list[str]]:
    """Run a command that must fail; return its exit code and the lines that it said."""
    done = subprocess.run(
        [str(part) for part in command], cwd=REPO, env=environment() | search_path(path),
        text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False,
    )  # fmt: skip
    return done.returncode, done.stdout.splitlines()


def test_a_rank_that_is_killed_ends_the_training(tiny_config, tmp_path):
    (tmp_path / "dies.py").write_text(DIES)
    (tmp_path / "leaf.py").write_text(
        f"_base_ = '{tiny_config}'\ncustom_hooks = [dict(type='Dies')]\n"
        "custom_imports = dict(imports=['gsmap.registered', 'dies'], allow_failed_imports=False)\n"
    )
    code, lines = end(
        DIST_TRAIN, tmp_path / "leaf.py", 2, "--work-dir", tmp_path / "work",
        path=tmp_path,
    )  # fmt: skip
    assert code == 128 + signal.SIGKILL
    assert lines[-1] == (
        "error: rank 1 was killed (SIGKILL, most likely for want of memory), so the run was "
        "stopped; --resume goes on from its last checkpoint."
    )


def test_a_rank_that_fails_ends_the_others_with_its_reason(tmp_path):
    (tmp_path / "waits.py").write_text(WAITS)
    code, lines = end("tools/dist_run.sh", 2, tmp_path / "waits.py", path=tmp_path)
    assert code == 2
    assert "error: sample 'a' is broken" in lines
    assert re.fullmatch(r"error: rank \d ended with 2 \(.*\), so the run was stopped\.", lines[-1])
    assert all(line.startswith("error: ") for line in lines[-2:])
