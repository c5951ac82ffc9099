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
from processes import REPO, run_python

ENVIRONMENT = {"PYTHON": sys.executable, "PORT": "29614", "OMP_NUM_THREADS": "1"}
LONG = ["--cfg-options", "train_cfg.max_epochs=500", "train_cfg.val_interval=500"]


def training(config: Path, work: Path, *words: str, ranks: int = 0) -> subprocess.Popen:
    """Start a training and wait for its first checkpoint."""
    command = [sys.executable, "tools/train.py", str(config)]
    if ranks:
        command = ["tools/dist_train.sh", str(config), str(ranks)]
    process = subprocess.Popen(
        [*command, "--work-dir", str(work), *LONG, *words],
        cwd=REPO, env=os.environ | ENVIRONMENT, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    while not (work / "last_checkpoint").exists():
        assert process.poll() is None, process.stdout.read()[-3000:]
        time.sleep(0.05)
    return process


def children(pid: int) -> list[int]:
    return [int(n) for n in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def test_a_work_folder_has_one_training(tiny_config, tmp_path):
    with training(tiny_config, tmp_path) as first:
        before = sorted(os.listdir(tmp_path))
        second = run_python(
            "tools/train.py", tiny_config, "--work-dir", tmp_path, *LONG, env=ENVIRONMENT
        )
        assert second.returncode == 2
        assert re.fullmatch(
            rf"error: {tmp_path} is in use by process {first.pid} on \S+ since [\d: -]+: wait for "
            r"its end, or give another --work-dir\.\n",
            second.stderr,
        )
        assert len([name for name in before if name.startswith("20")]) == 1  # folders of runs
        assert len(list(tmp_path.glob("20*"))) == 1
        first.kill()


def test_a_rank_that_hangs_is_named_within_the_timeout(tiny_config, tmp_path):
    limit_s = 20.0
    option = f"env_cfg.dist_cfg.timeout={limit_s:g}"
    with training(tiny_config, tmp_path, option, ranks=2) as launcher:
        ranks = {
            int(re.search(r"\0RANK=(\d+)\0", Path(f"/proc/{pid}/environ").read_text())[1]): pid
            for pid in children(launcher.pid)
        }
        os.kill(ranks[1], signal.SIGSTOP)
        stopped = time.monotonic()
        said = next(line for line in launcher.stdout if line.startswith("error: "))
        assert time.monotonic() - stopped < limit_s
        os.kill(ranks[1], signal.SIGKILL)  # torchrun itself waits 30 s before it does
        rest = launcher.stdout.read()
    assert re.match(rf"error: rank 1 \(process {ranks[1]} on \S+, at .*\) does not answer; ", said)
    assert f"timeout is {limit_s:g}" in said
    assert "Traceback" not in rest
    assert rest.splitlines()[-1].startswith("error: rank 0 ended with 2 (its own words stand above)")
    assert launcher.returncode == 2


def test_a_run_that_diverges_says_what_to_lower_and_resumes_from_the_last_good(
    tiny_config, tmp_path
):
    train = ["tools/train.py", tiny_config, "--work-dir", tmp_path, "--resume", "--cfg-options"]
    epochs = "train_cfg.max_epochs={}"
    assert run_python(*train, epochs.format(1), env=ENVIRONMENT).returncode == 0
    (tmp_path / "rate.py").write_text(
        "from mmengine.hooks import Hook\nfrom mmengine.registry import HOOKS\n"
        "@HOOKS.register_module()\nclass Rate(Hook):\n"
        "    def before_train_iter(self, runner, batch_idx, data_batch=None):\n"
        "        if runner.iter == 3:  # the last of the second epoch\n"
        "            runner.optim_wrapper.param_groups[0]['lr'] = 1e30\n"
    )
    (tmp_path / "leaf.py").write_text(
        f"_base_ = '{tiny_config}'\ncustom_hooks = [dict(type='Rate')]\n"
        "custom_imports = dict(imports=['gsmap.registered', 'rate'])\n"
    )
    paths = os.pathsep.join([str(tmp_path), os.environ["PYTHONPATH"]])
    train[1] = tmp_path / "leaf.py"
    done = run_python(*train, epochs.format(4), env=ENVIRONMENT | {"PYTHONPATH": paths})
    assert done.returncode == 2, done.stderr
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    print(line)
    assert sorted(path.name for path in tmp_path.glob("*.pth")) == ["epoch_1.pth"]
