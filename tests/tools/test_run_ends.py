"""How a training ends that cannot go on: another one's folder, a rank that hangs, divergence."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from mmengine.hooks import Hook
from mmengine.registry import HOOKS
from processes import REPO, free_port, search_path, wait_for

import tools.train
from gsmap.engine.run_log import MapRunner
from gsmap.models.base.head import MapHead
from gsmap.utils.cli import run_command

pytestmark = pytest.mark.faults

ENVIRONMENT = {"PYTHON": sys.executable, "OMP_NUM_THREADS": "1"}
LONG = ["--cfg-options", "train_cfg.max_epochs=500", "train_cfg.val_interval=500"]


def training(config: Path, work: Path, *words: str, ranks: int = 0) -> subprocess.Popen:
    """Start a training and wait for its first checkpoint."""
    command = [sys.executable, "tools/train.py", str(config)]
    if ranks:
        command = ["tools/dist_train.sh", str(config), str(ranks)]
    environment = os.environ | ENVIRONMENT | search_path() | {"PORT": str(free_port())}
    process = subprocess.Popen(
        [*command, "--work-dir", str(work), *LONG, *words], cwd=REPO, env=environment, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    wait_for(work / "last_checkpoint", process)
    return process


def children(pid: int) -> list[int]:
    return [int(n) for n in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def has_pending(pid: int, number: signal.Signals) -> bool:
    """Whether a signal has been sent to a process that is stopped."""
    status = Path(f"/proc/{pid}/status").read_text()
    return bool(int(re.search(r"ShdPnd:\s*(\w+)", status)[1], 16) >> (number - 1) & 1)


@pytest.fixture
def train(monkeypatch):
    """Run ``tools/train.py`` in this process with the words that are given."""

    def run(*words: object) -> None:
        monkeypatch.setattr(sys, "argv", ["train.py", *map(str, words)])
        run_command(tools.train.main, clean_up_on_kill=False)

    return run


def test_a_work_folder_has_one_training(tiny_config, tmp_path, train, monkeypatch, capsys):
    words = tiny_config, "--work-dir", tmp_path

    def second(runner: MapRunner) -> None:
        with pytest.raises(SystemExit) as left:
            train(*words)
        assert left.value.code == 2

    monkeypatch.setattr(MapRunner, "train", second)
    train(*words)
    assert re.fullmatch(
        rf"error: {tmp_path} is in use by process {os.getpid()} on \S+ since [\d: -]+: wait for "
        r"its end, or give another --work-dir\.\n",
        capsys.readouterr().err,
    )
    assert len(list(tmp_path.glob("20*"))) == 1  # the first one's log


def test_a_rank_that_hangs_is_named_within_the_timeout(tiny_config, tmp_path):
    """It is named by another rank, after 35 s, and not by the operation that fails after 200."""
    limit_s = 200.0
    options = (
        f"env_cfg.dist_cfg.timeout={limit_s:g}",
        "custom_imports.imports=[gsmap.registered,waiting]",
        "custom_hooks.1.type=LooksEarly",
    )
    with training(tiny_config, tmp_path, *options, ranks=2) as launcher:
        ranks = {
            int(re.search(r"\0RANK=(\d+)\0", Path(f"/proc/{pid}/environ").read_text())[1]): pid
            for pid in children(launcher.pid)
        }
        os.kill(ranks[1], signal.SIGSTOP)
        said = next(line for line in launcher.stdout if line.startswith("error: "))
        while not has_pending(ranks[1], signal.SIGTERM):  # torchrun's, which has seen rank 0 end
            time.sleep(0.02)
        os.kill(ranks[1], signal.SIGCONT)  # heeds it; torchrun's SIGKILL would come after 30 s
        rest = launcher.stdout.read()
    assert re.match(rf"error: rank 1 \(process {ranks[1]} on \S+, at .*\) does not answer; ", said)
    assert f"timeout is {limit_s:g}" in said
    assert "Traceback" not in rest
    assert rest.splitlines()[-1].startswith(
        "error: rank 0 ended with 2 (its own words stand above)"
    )
    assert launcher.returncode == 2


@HOOKS.register_module()
class Diverge(Hook):
    """Spoils the last step of the second epoch."""

    def before_train_iter(self, runner, batch_idx, data_batch=None):
        if runner.iter == 3:
            runner.optim_wrapper.param_groups[0]["lr"] = float("inf")


def test_a_run_that_diverges_says_what_to_lower_and_resumes_from_the_last_good(
    tiny_config, tmp_path, train, capsys
):
    words = tiny_config, "--work-dir", tmp_path, "--resume", "--cfg-options"
    with pytest.raises(SystemExit) as left:
        train(*words, "custom_hooks.1.type=Diverge")
    assert left.value.code == 2
    good = tmp_path / "epoch_1.pth"
    assert re.fullmatch(
        r"error: weights are NaN or infinite \(.+\), so they are not saved. The training has "
        r"diverged at iteration 4: start it from its last good checkpoint with a lower learning "
        rf"rate than inf \(--work-dir NEW --cfg-options load_from={good} "
        r"optim_wrapper.optimizer.lr=\.\.\.\)\.\n",
        capsys.readouterr().err,
    )
    assert not (tmp_path / "epoch_2.pth").exists()
    state = torch.load(good, weights_only=False)
    next(iter(state["state_dict"].values())).fill_(torch.nan)
    torch.save(state, bad := tmp_path / "epoch_2.pth")  # of an earlier version
    train(*words, "train_cfg.max_epochs=2")
    said = capsys.readouterr().out
    assert re.search(rf"{bad} holds NaN or infinite weights .* It is passed over\.", said)
    assert "goes on after iteration 2" in said


def test_losses_that_are_not_finite_are_one_line(tiny_config, tmp_path, train, capsys, monkeypatch):
    def broken(*_: object) -> dict[str, torch.Tensor]:
        return {"loss_pts": torch.tensor(torch.nan)}

    monkeypatch.setattr(MapHead, "loss", broken)
    with pytest.raises(SystemExit) as left:
        train(tiny_config, "--work-dir", tmp_path)
    assert left.value.code == 2
    assert re.fullmatch(
        r"error: losses \['loss_pts'\] are not finite; .*: start it again with a lower learning "
        r"rate than 0\.\d+ \(--work-dir NEW --cfg-options optim_wrapper.optimizer.lr=\.\.\.\)\.\n",
        capsys.readouterr().err,
    )
    assert not list(tmp_path.glob("*.pth"))
