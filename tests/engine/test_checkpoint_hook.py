import os
import pickle
import random
import signal
import subprocess
import sys
import textwrap
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
import torch
from fuzz.attacks import Calls
from mmengine.evaluator import BaseMetric, Evaluator
from mmengine.fileio import get_file_backend
from mmengine.logging import MessageHub
from mmengine.model import BaseModel
from mmengine.registry import PARAM_SCHEDULERS
from mmengine.runner import BaseLoop
from mmengine.runner.checkpoint import save_checkpoint
from processes import run_python
from torch.utils.data import BatchSampler, ConcatDataset

import gsmap.registered  # noqa: F401
from gsmap.checkpoints.reading import read_checked
from gsmap.checkpoints.safe_globals import mmengine_globals
from gsmap.engine import checkpoint_hook, resuming
from gsmap.engine.checkpoint_hook import AtomicCheckpointHook, AtomicLocalBackend
from gsmap.engine.resuming import check_optimizer_state
from gsmap.engine.run_log import MapRunner
from gsmap.utils.files import SUFFIX
from gsmap.utils.shards import digest
from gsmap.utils.worker_seeds import follow_epoch


@pytest.fixture
def safe_globals():
    """What a run's hook does before mmengine reads a checkpoint, for one test."""
    with torch.serialization.safe_globals(mmengine_globals()):
        yield


@pytest.mark.faults
def test_an_import_changes_nothing_of_mmengine_and_torch():
    code = (
        "import torch\n"
        "import gsmap.registered, gsmap.apis.map_inferencer\n"
        "from mmengine.fileio import LocalBackend, get_file_backend\n"
        "from mmengine.logging import HistoryBuffer\n"
        "assert HistoryBuffer not in torch.serialization.get_safe_globals()\n"
        "assert type(get_file_backend('a.pth')) is LocalBackend\n"
    )
    done = run_python("-c", code)
    assert done.returncode == 0, done.stderr


def test_the_hook_writes_through_the_atomic_backend_and_lets_torch_read():
    before = torch.serialization.get_safe_globals()
    hook = AtomicCheckpointHook(interval=1)
    assert isinstance(get_file_backend("a.pth", backend_args=hook.backend_args), AtomicLocalBackend)
    assert (
        AtomicCheckpointHook(backend_args={"backend": "local"}).backend_args["backend"] == "local"
    )
    try:
        hook.before_run(None)
        assert set(mmengine_globals()) <= set(torch.serialization.get_safe_globals())
    finally:
        torch.serialization.clear_safe_globals()
        torch.serialization.add_safe_globals(before)


@pytest.mark.faults
def test_a_fetched_checkpoint_runs_no_code(monkeypatch, tmp_path):
    """What ``load_from`` and ``init_cfg`` name by an address is read by torch's own hub."""
    code = (
        "import sys, threading, torch\n"
        "from http.server import HTTPServer, SimpleHTTPRequestHandler\n"
        "from mmengine.runner import load_checkpoint\n"
        "from gsmap.engine.checkpoint_hook import AtomicCheckpointHook\n"
        "server = HTTPServer(('127.0.0.1', 0), SimpleHTTPRequestHandler)\n"
        "threading.Thread(target=server.serve_forever, daemon=True).start()\n"
        "if sys.argv[1] == 'hook': AtomicCheckpointHook().before_run(None)\n"
        "address = f'http://127.0.0.1:{server.server_port}/a.pth'\n"
        "from gsmap.utils.cli import run_command\n"
        "run_command(lambda: load_checkpoint(torch.nn.Linear(1, 1), address) and None)\n"
    )
    torch.save({"x": Calls(open, str(tmp_path / "proof"), "w")}, tmp_path / "a.pth")
    for name in ("http_proxy", "HTTP_PROXY", "TORCH_FORCE_WEIGHTS_ONLY_LOAD"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "cache"))
    refused = run_python("-c", code, "hook", cwd=tmp_path)
    assert refused.returncode == 2
    (line,) = [line for line in refused.stderr.splitlines() if line.startswith("error: ")]
    assert "/a.pth was not loaded: it is broken, or holds more than tensors" in line
    assert "Traceback" not in refused.stderr
    assert not (tmp_path / "proof").exists()
    run_python("-c", code, "no hook", cwd=tmp_path)
    assert (tmp_path / "proof").exists()  # the attack works


@pytest.mark.usefixtures("safe_globals")
def test_a_message_hub_comes_back_with_weights_only(tmp_path):
    hub = MessageHub.get_instance("checkpoint-io-test")
    for value in (3.0, 2.0, np.float64(1.0)):
        hub.update_scalar("train/loss", value)
    path = str(tmp_path / "epoch_1.pth")
    save_checkpoint({"message_hub": hub.state_dict(), "state_dict": {"w": torch.ones(2)}}, path)

    loaded = torch.load(path, weights_only=True)

    history = loaded["message_hub"]["log_scalars"]["train/loss"]
    np.testing.assert_array_equal(history.data[0], [3.0, 2.0, 1.0])


def test_code_in_a_checkpoint_does_not_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    torch.save({"state_dict": Calls(os.system, "touch pwned")}, "bad.pth")
    with pytest.raises(pickle.UnpicklingError, match="Weights only load failed"):
        torch.load("bad.pth")
    assert not (tmp_path / "pwned").exists()


@pytest.mark.usefixtures("safe_globals")
def test_a_checkpoint_may_not_look_up_anything_else(tmp_path):
    torch.save({"state_dict": Calls(getattr, np.dtype, "__init__")}, tmp_path / "bad.pth")
    with pytest.raises(pickle.UnpicklingError, match="must not look up '__init__'"):
        torch.load(tmp_path / "bad.pth")


def test_text_is_written_in_one_step(tmp_path):
    path = tmp_path / "new" / "log.txt"
    AtomicLocalBackend().put_text("h\u00e9", path)
    assert path.read_text(encoding="utf-8") == "h\u00e9"
    assert os.listdir(path.parent) == ["log.txt"]


def test_a_failed_write_keeps_the_old_file_and_leaves_nothing_behind(tmp_path):
    path = tmp_path / "epoch_1.pth"
    path.write_bytes(b"old")
    with pytest.raises(TypeError):
        AtomicLocalBackend().put("not bytes", path)
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["epoch_1.pth"]


@pytest.mark.faults
def test_a_killed_writer_leaves_the_old_file_whole(tmp_path):
    path = tmp_path / "last.pth"
    path.write_bytes(b"whole")
    code = textwrap.dedent(
        f"""
        from gsmap.engine.checkpoint_hook import AtomicLocalBackend
        backend = AtomicLocalBackend()
        print("ready", flush=True)
        while True:
            backend.put(b"whole" * 20_000_000, {str(path)!r})
        """
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as writer:
        assert writer.stdout.readline() == b"ready\n"
        while not list(tmp_path.glob(f"*{SUFFIX}")):  # in the middle of one of the writes
            assert writer.poll() is None
        writer.send_signal(signal.SIGKILL)
    content = path.read_bytes()
    assert content in (b"whole", b"whole" * 20_000_000)


class Learner(BaseModel):
    """One weight that learns to be zero, and counts its validations."""

    validations = 0

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.ones(1))

    def forward(self, inputs, data_samples=None, mode="tensor"):
        return {"loss": (self.weight**2).sum()}

    def val_step(self, data):
        type(self).validations += 1
        return [{}]


class Nothing(BaseMetric):
    def process(self, data_batch, data_samples):
        self.results.append(0)

    def compute_metrics(self, results):
        return {"figure": 1.0}


class Listed(list):
    """Samples of a data set, some of a split."""

    metainfo: dict


def listed(split_list: str, count: int = 1) -> Listed:
    data = Listed([{"inputs": torch.ones(1)}] * count)
    data.metainfo = {"dataset": "nuscenes", "split_list": split_list}
    return data


def learn(
    work_dir,
    epochs,
    resume_from=None,
    train=None,
    val=None,
    schedule=None,
    lr=0.1,
    model=Learner,
    loader=None,
    accumulative_counts=1,
    evaluator=None,
    **options,
) -> int:
    """Train for some epochs, with a validation after every second and the last; return how many."""
    Learner.validations = 0
    before = torch.serialization.get_safe_globals()
    data = [{"inputs": torch.ones(1)}] * 2
    if loader is None or "dataset" not in loader:
        loader = torch.utils.data.DataLoader(train or data, **(loader or {}))
    runner = MapRunner(
        model(),
        str(work_dir),
        train_dataloader=loader,
        val_dataloader=torch.utils.data.DataLoader(val or data[:1]),
        train_cfg={"by_epoch": True, "max_epochs": epochs, "val_interval": 2},
        val_cfg={},
        val_evaluator=evaluator or Evaluator(Nothing()),
        optim_wrapper={
            "optimizer": {"type": "SGD", "lr": lr},
            "accumulative_counts": accumulative_counts,
        },
        param_scheduler=schedule,
        default_hooks={"checkpoint": {"type": "AtomicCheckpointHook", "interval": 1, **options}},
        load_from=resume_from and str(resume_from),
        resume=resume_from is not None,
        experiment_name=f"learn-{work_dir.name}-{epochs}-{resume_from is None}",
        randomness={"seed": None},  # mmengine writes to its default value on resumption
        default_scope="mmdet3d",
        cfg={"model": {"type": "Learner", "size": (1, 2)}, "param_scheduler": schedule},
    )
    try:
        runner.train()
    finally:
        torch.serialization.clear_safe_globals()
        torch.serialization.add_safe_globals(before)
    return Learner.validations


def test_a_validation_that_a_kill_prevented_is_made_up_for(tmp_path):
    assert learn(tmp_path, 3) == 2  # after epochs 2 and 3
    assert learn(tmp_path, 3, tmp_path / "epoch_3.pth") == 0  # all is done
    (tmp_path / "last_validation").write_text("4")  # as after a kill between epoch 3 and its end
    assert learn(tmp_path, 3, tmp_path / "epoch_3.pth") == 1
    assert learn(tmp_path, 3, tmp_path / "epoch_2.pth") == 2  # that of epoch 2, then 3's


def test_a_new_run_names_the_checkpoints_that_it_replaces(tmp_path):
    learn(tmp_path, 1)
    learn(tmp_path, 2, tmp_path / "epoch_1.pth")
    logs = "".join(path.read_text() for path in tmp_path.glob("*/*.log"))
    assert "of an earlier run" not in logs
    learn(tmp_path, 3)
    logs = "".join(path.read_text() for path in tmp_path.glob("*/*.log"))
    assert logs.count("of an earlier run (epoch_1.pth, epoch_2.pth), which this new run") == 1


@pytest.mark.parametrize(
    ("part", "values", "reason"),
    [
        ("", {"meta": None}, "it holds weights and no meta"),
        ("", {"meta": None, "message_hub": None, "optimizer": 3}, "no meta and no message_hub and"),
        ("", {"meta": [1]}, "it holds weights and no meta"),
        ("", {"message_hub": "x"}, "no message_hub"),
        ("meta", {"epoch": "x"}, "its epoch is 'x'"),
        ("meta", {"epoch": 10**12}, r"its epoch is 10+, and train_cfg.max_epochs is 2"),
        ("meta", {"epoch": True}, "its epoch is True"),
        ("meta", {"iter": -5}, "its iter is -5"),
        ("meta", {"iter": None}, "its iter is None"),
        ("meta", {"seed": "x"}, "its seed is 'x'"),
        ("meta", {"seed": 2**40}, "its seed is 1099"),
        ("message_hub", {"runtime_info": 1}, "its message_hub has no runtime_info"),
        ("optimizer", {"state": 1}, "its optimizer has no state and param_groups"),
        ("optimizer", {"param_groups": [1]}, "its optimizer has no state and param_groups"),
        ("optimizer", {"param_groups": []}, "different number of parameter groups"),
        ("optimizer", {"param_groups": [{"params": 3}]}, r"its state does not fit \(TypeError"),
        ("", {"param_schedulers": []}, "it has 0 schedules, and the config 1"),
        ("", {"param_schedulers": [{"step": 5}]}, "a schedule has a state 'step'"),
        ("", {"param_schedulers": [7]}, "are no list of states"),
        ("", {"param_schedulers": [{"last_step": "x"}]}, "a schedule has last_step = 'x'"),
        ("", {"param_schedulers": [{"base_values": ["x"]}]}, r"has base_values = \['x'\]"),
        ("message_hub", {"log_scalars": {"loss": [1.0]}}, "has 'loss' without a history"),
    ],
)
def test_a_checkpoint_that_cannot_be_resumed_from_says_why(part, values, reason, tmp_path):
    schedule = {"type": "LinearLR", "start_factor": 0.1, "end": 5}
    learn(tmp_path, 1, schedule=schedule)
    with torch.serialization.safe_globals(mmengine_globals()):
        checkpoint = torch.load(tmp_path / "epoch_1.pth", weights_only=True)
    (checkpoint[part] if part else checkpoint).update(values)
    torch.save(checkpoint, tmp_path / "odd.pth")
    with pytest.raises(ValueError, match=reason):
        learn(tmp_path, 2, tmp_path / "odd.pth", schedule=schedule)
    assert learn(tmp_path, 2, tmp_path / "epoch_1.pth", schedule=schedule) == 1


@pytest.mark.parametrize(
    ("setting", "entry", "reason"),
    [
        ({"lr": "x"}, {}, "lr = 'x'"),
        ({"lr": float("nan")}, {}, "lr = nan"),
        ({"betas": 3}, {}, "betas = 3"),
        ({"betas": (0.9, "x")}, {}, "betas = "),
        ({"eps": None}, {}, "eps = None"),
        ({}, {"step": "x"}, "a 'step' that does not fit"),
        ({}, {"exp_avg": torch.zeros(3)}, "a 'exp_avg' that does not fit"),
        ({}, {"exp_avg_sq": torch.full((2,), float("nan"))}, "a 'exp_avg_sq' that does not fit"),
    ],
)
def test_an_optimizers_state_fits_its_parameters(setting, entry, reason):
    weight = torch.nn.Parameter(torch.ones(2))
    optimizer = torch.optim.AdamW([weight])
    weight.grad = torch.ones(2)
    optimizer.step()
    state = optimizer.state_dict()
    check_optimizer_state(state, optimizer, path="good.pth")
    state["param_groups"][0].update(setting)
    state["state"][0].update(entry)
    with pytest.raises(ValueError, match=f"odd.pth cannot be resumed from: its .*{reason}"):
        check_optimizer_state(state, optimizer, path="odd.pth")


@pytest.mark.parametrize(
    ("lr", "end", "said"),
    [
        (0.1, 5, []),
        (0.2, 5, ["lr 0.1 (config: 0.2)"]),
        (0.1, 7, ["LinearLR.total_iters 4 (config: 6)", "LinearLR.end 5 (config: 7)"]),
    ],
)
def test_a_resumed_run_says_which_settings_the_checkpoint_replaces(lr, end, said, tmp_path):
    schedule = {"type": "LinearLR", "start_factor": 0.1, "end": 5}
    start = tmp_path / "epoch_1.pth"
    learn(tmp_path, 1, schedule=schedule)
    learn(tmp_path, 2, start, schedule={**schedule, "end": end}, lr=lr)
    log = "".join(path.read_text() for path in tmp_path.glob("*/*.log"))
    assert log.count("goes on with the settings of") == bool(said)
    assert f"goes on with the settings of {start}: {', '.join(said)}. For" in log or not said


@pytest.mark.parametrize("length", [3, 6])
def test_a_schedule_over_iterations_ends_with_the_training(length, tmp_path):
    """Two epochs have two iterations each."""
    schedule = {"type": "CosineAnnealingLR", "by_epoch": False, "T_max": 4}
    learn(tmp_path, 2, schedule=schedule)
    with pytest.raises(ValueError, match=f"lasts 4 iterations but the cosine schedule {length}"):
        learn(tmp_path, 2, schedule={**schedule, "T_max": length})


def test_weights_alone_cannot_be_resumed_from(tmp_path):
    torch.save({"weight": torch.ones(1)}, tmp_path / "bare.pth")
    with pytest.raises(ValueError, match=r"bare.pth cannot be resumed from: it holds weights and"):
        learn(tmp_path, 2, tmp_path / "bare.pth")


class Noisy(Learner):
    """A learner with random numbers of all libraries in its loss, as dropout has them."""

    def forward(self, inputs, data_samples=None, mode="tensor"):
        noise = random.gauss(1, 0.1) + np.random.normal() + torch.rand(())  # noqa: NPY002
        return {"loss": noise * (self.weight**2).sum()}


@pytest.mark.parametrize("loader", [{}, {"num_workers": 1, "persistent_workers": True}])
@pytest.mark.parametrize("options", [{}, {"save_best": "figure", "rule": "greater"}])
def test_a_resumed_run_has_the_random_numbers_of_the_stopped_one(loader, options, tmp_path):
    options = {**options, "model": Noisy, "loader": loader}
    learn(tmp_path / "whole", 4, **options)
    for epoch in (1, 2):  # without a validation after it, and with one
        random.seed(5)
        np.random.seed(5)  # noqa: NPY002
        torch.manual_seed(5)
        work = tmp_path / f"resumed {epoch}"
        learn(work, 4, tmp_path / f"whole/epoch_{epoch}.pth", **options)
        found = torch.load(work / "epoch_4.pth", weights_only=False)
        wanted = torch.load(tmp_path / "whole/epoch_4.pth", weights_only=False)
        assert torch.equal(found["state_dict"]["weight"], wanted["state_dict"]["weight"])


def test_a_schedule_that_holds_a_function_is_resumed(tmp_path):
    cycle = {"type": "OneCycleLR", "eta_max": 0.2, "total_steps": 8, "by_epoch": False}
    learn(tmp_path / "whole", 4, schedule=cycle)
    learn(tmp_path / "resumed", 4, tmp_path / "whole/epoch_2.pth", schedule=cycle)
    found = read_checked(tmp_path / "resumed/epoch_4.pth").state["weight"]
    assert torch.equal(found, read_checked(tmp_path / "whole/epoch_4.pth").state["weight"])
    log = "".join(path.read_text() for path in tmp_path.glob("resumed/*/*.log"))
    assert "goes on with the settings of" not in log


@pytest.mark.parametrize(
    ("value", "named"),
    [
        (Path("a"), "mine of the checkpoint is a PosixPath"),
        ({"x": [1, lambda: 0]}, r"mine\.x\.1 of the checkpoint is a function"),
    ],
)
def test_what_loading_would_refuse_is_not_saved(value, named, tmp_path):
    class Setting(Learner):
        def forward(self, *args, **kwargs):
            MessageHub.get_current_instance().update_info("mine", value)
            return super().forward(*args, **kwargs)

    with pytest.raises(ValueError, match=rf"message_hub\.runtime_info\.{named}"):
        learn(tmp_path, 2, model=Setting)
    assert not list(tmp_path.glob("*.pth"))


class Augmented(torch.utils.data.Dataset):
    """Samples with random numbers of all libraries, drawn where they are loaded."""

    def __len__(self):
        return 4

    def __getitem__(self, index):
        follow_epoch()
        noise = random.gauss(1, 0.1) + np.random.normal() + torch.rand(())  # noqa: NPY002
        return {"inputs": noise + index}


class Reader(Learner):
    """A learner with its inputs in its loss."""

    def forward(self, inputs, data_samples=None, mode="tensor"):
        return {"loss": (inputs * self.weight**2).sum()}


@pytest.mark.parametrize("persistent", [False, True])
def test_a_resumed_run_has_the_augmentation_of_the_stopped_one(persistent, tmp_path):
    loader = {"num_workers": 2, "persistent_workers": persistent}
    options = {"model": Reader, "loader": loader, "train": Augmented(), "lr": 0.01}
    learn(tmp_path / "whole", 3, **options)
    learn(tmp_path / "resumed", 3, tmp_path / "whole/epoch_1.pth", **options)
    found = torch.load(tmp_path / "resumed/epoch_3.pth", weights_only=False)
    wanted = torch.load(tmp_path / "whole/epoch_3.pth", weights_only=False)
    assert torch.equal(found["state_dict"]["weight"], wanted["state_dict"]["weight"])


class Recorder(Learner):
    """A learner that notes its inputs."""

    seen: ClassVar[list[float]] = []

    def forward(self, inputs, data_samples=None, mode="tensor"):
        self.seen.extend(map(float, inputs))
        return super().forward(inputs)


@pytest.mark.parametrize("batches", [None, {"type": BatchSampler, "drop_last": True}])
def test_a_resumed_run_without_a_seed_has_the_order_of_the_stopped_one(batches, tmp_path):
    data = [{"inputs": torch.tensor(float(number))} for number in range(8)]
    sampler = {"type": "DefaultSampler", "shuffle": True}
    loader = {"dataset": data, "batch_size": 2, "sampler": sampler, "batch_sampler": batches}
    options = {"loader": loader, "model": Recorder}
    Recorder.seen.clear()
    learn(tmp_path / "whole", 3, **options)
    wanted = Recorder.seen[8:]
    Recorder.seen.clear()
    np.random.seed(5)  # noqa: NPY002 - mmengine draws a seed from it
    learn(tmp_path / "resumed", 3, tmp_path / "whole/epoch_1.pth", **options)
    assert Recorder.seen == wanted


def test_a_run_with_a_list_as_sampler_is_resumed(tmp_path):
    loader = {"sampler": [1, 0]}
    learn(tmp_path, 1, loader=loader)
    assert learn(tmp_path, 2, tmp_path / "epoch_1.pth", loader=loader)


def test_a_resumed_run_with_larger_batches_counts_its_own_iterations(tmp_path):
    data = [{"inputs": torch.ones(1)}] * 8
    learn(tmp_path, 3, train=data)
    start, loader = tmp_path / "epoch_3.pth", {"batch_size": 4}
    assert learn(tmp_path, 4, start, train=data, loader=loader, accumulative_counts=2) == 1
    meta = torch.load(tmp_path / "epoch_4.pth", weights_only=False)["meta"]
    assert (meta["epoch"], meta["iter"]) == (4, 8)
    log = "".join(path.read_text() for path in tmp_path.glob("*/*.log"))
    assert "after 24 iterations, and this run has 2 in each epoch" in log
    assert "goes on after iteration 6" in log


@pytest.mark.parametrize(
    "schedule",
    [
        {"type": "CosineAnnealingLR", "T_max": 24},
        {"type": "MultiStepLR", "milestones": [20]},
        {"type": "StepLR", "step_size": 8},
        {"type": "LinearLR", "start_factor": 0.1, "end": 24},
    ],
)
@pytest.mark.parametrize("lengths", [(4, 2), (2, 4)])
def test_schedules_over_epochs_fit_epochs_of_another_length(schedule, lengths):
    """A training of 24 epochs is stopped after 12, and resumed with epochs of another length."""

    def build(epoch_length):
        optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=1.0)
        settings = {**schedule, "by_epoch": True, "convert_to_iter_based": True}
        settings |= {"optimizer": optimizer, "epoch_length": epoch_length}
        return optimizer, PARAM_SCHEDULERS.build(settings)

    def run(optimizer, scheduler, iterations):
        for _ in range(iterations):
            optimizer.step()
            scheduler.step()
        return optimizer.param_groups[0]["lr"]

    before, after = lengths
    optimizer, scheduler = build(before)
    rate = run(optimizer, scheduler, 12 * before)
    warm_up = {"begin": 0, "end": 500, "last_step": 8, "_global_step": 9}
    checkpoint = {"param_schedulers": [dict(warm_up), scheduler.state_dict()]}
    configs = [{"by_epoch": False}, {"by_epoch": True, "convert_to_iter_based": True}]
    resuming.fit_schedules(checkpoint, configs, ratio=after / before)
    assert checkpoint["param_schedulers"][0] == warm_up
    resumed, going_on = build(after)
    resumed.param_groups[0]["lr"] = rate
    going_on.load_state_dict(checkpoint["param_schedulers"][1])
    end = run(resumed, going_on, 12 * after)
    whole, whole_schedule = build(after)
    assert end == pytest.approx(run(whole, whole_schedule, 24 * after), abs=0.05)
    kept = {"param_schedulers": [dict(warm_up)]}
    resuming.fit_schedules(kept, configs, ratio=0.5)  # schedules of another config
    assert kept["param_schedulers"] == [warm_up]
    resuming.fit_schedules(kept, configs[1], ratio=0.5)  # a single schedule without a list
    assert kept["param_schedulers"] == [{"last_step": 4, "_global_step": 4}]


def test_ranks_that_begin_differently_are_refused(tmp_path, monkeypatch):
    """As on two machines that do not share the work folder."""
    learn(tmp_path, 1)
    monkeypatch.setattr(checkpoint_hook, "all_gather_object", lambda value: [value, value])
    assert learn(tmp_path, 2, tmp_path / "epoch_1.pth") == 1
    other = "iteration 0 (no checkpoint)"
    monkeypatch.setattr(checkpoint_hook, "all_gather_object", lambda value: [value, other])
    text = r"rank 0 begins at iteration 2 \(epoch_1\.pth\), but rank 1 at iteration 0 .*one folder"
    with pytest.raises(ValueError, match=text):
        learn(tmp_path, 3, tmp_path / "epoch_1.pth")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("numpy", ("MT19937", (0,) * 624, 625, 0, 0.0)),
        ("numpy", ("MT19937", (0,) * 9, 0, 0, 0.0)),
        ("numpy", 3),
        ("python", (3, (1, 2), None)),
        ("torch", torch.zeros(3, dtype=torch.uint8)),
        ("torch", torch.zeros(5056, dtype=torch.uint8)),
        ("torch", "x"),
        ("torch", None),
    ],
)
def test_malformed_random_numbers_are_refused(name, value, tmp_path):
    learn(tmp_path, 1)
    checkpoint = torch.load(tmp_path / "epoch_1.pth", weights_only=False)
    checkpoint["random_states"][0][name] = value
    torch.save(checkpoint, tmp_path / "odd.pth")
    with pytest.raises(ValueError, match=r"odd.pth cannot be resumed from: its random numbers"):
        learn(tmp_path, 2, tmp_path / "odd.pth")


def test_random_numbers_that_begin_anew_are_named(tmp_path):
    learn(tmp_path, 1)
    checkpoint = torch.load(tmp_path / "epoch_1.pth", weights_only=False)
    states = checkpoint["random_states"]
    for kind, values in (("two processes", states * 2), ("earlier version", None)):
        checkpoint["random_states"] = values
        work = tmp_path / kind
        work.mkdir()
        torch.save(checkpoint, work / "other.pth")
        learn(work, 2, work / "other.pth")
        (log,) = work.glob("*/*.log")
        assert f"begin anew: {work}/other.pth has none of 1 processes" in log.read_text()


def test_data_of_another_split_is_refused_unless_allowed(tmp_path):
    near, far = listed("near@" + "0" * 16, 2), listed("far@" + "0" * 16)
    with pytest.raises(
        ValueError, match=r"trained on the split near@0+, .* belongs to far@0+, .*allow_"
    ):
        learn(tmp_path, 2, train=near, val=far)
    learn(tmp_path, 1, train=near, val=far, allow_other_split=True)
    said = torch.load(tmp_path / "epoch_1.pth", weights_only=False)["meta"]["dataset_meta"]
    assert said["split_list"] == near.metainfo["split_list"]
    with pytest.raises(ValueError, match="the model was trained on the split near"):
        learn(tmp_path, 2, tmp_path / "epoch_1.pth", train=far, val=far)
    assert learn(tmp_path, 2, tmp_path / "epoch_1.pth", train=near, val=listed("")) == 1


class Scoring(BaseLoop):
    """A test that is about to run."""

    def __init__(self):
        self.evaluator = Evaluator(Nothing())
        self.evaluator.dataset_meta = {"classes": ["divider"]}

    def run(self):
        raise AssertionError


def test_a_test_tells_results_which_checkpoint_it_is_of_and_how_that_was_calibrated(tmp_path):
    path, calibration = tmp_path / "a.pth", {"law": "laplace", "sigmas": 1.0}
    path.write_bytes(b"weights")
    for meta, address in (({"calibration": calibration}, path), ({}, "https://host/a.pth")):
        loop = Scoring()
        runner = SimpleNamespace(
            _val_loop=None, _test_loop=loop, _resume=False, _load_from=str(address)
        )
        content = {"state_dict": {"w": torch.ones(1)}, "meta": meta}
        AtomicCheckpointHook(interval=1).after_load_checkpoint(runner, content)
        said = loop.evaluator.metrics[0].dataset_meta
        assert said["classes"] == ["divider"]
        assert said.get("checkpoint") == (digest(path) if meta else None)
        assert said["calibration"] == meta.get("calibration", {})
    with pytest.raises(ValueError, match="calibration must name a law"):
        AtomicCheckpointHook(interval=1).after_load_checkpoint(
            runner, {"model": {"w": torch.ones(1)}, "meta": {"calibration": "x"}}
        )


def test_the_best_of_the_validations_is_kept(tmp_path):
    learn(tmp_path, 3, save_best="figure", rule="greater")
    assert [path.name for path in tmp_path.glob("best*")] == ["best_figure_epoch_2.pth"]
    with pytest.raises(ValueError, match=r"names 'chamfer/mAP', .* measure; it measures figure\."):
        learn(tmp_path / "other", 2, save_best="chamfer/mAP", rule="greater")


@pytest.mark.parametrize("save_best", ["auto", "loss/figure"])
def test_a_resumed_run_keeps_no_score_of_another_metric(save_best, tmp_path):
    class Measuring(Nothing):
        def compute_metrics(self, results):
            return {"loss/figure": 1.0, "figure": 5.0}

    evaluator = Evaluator(Measuring())
    learn(tmp_path, 2, save_best="figure", rule="greater", evaluator=evaluator)
    start = tmp_path / "epoch_2.pth"
    learn(tmp_path, 4, start, save_best=save_best, rule="greater", evaluator=evaluator)
    names = sorted(path.name for path in tmp_path.glob("best*"))
    assert names == ["best_figure_epoch_2.pth", "best_loss_figure_epoch_4.pth"]
    logs = "".join(path.read_text() for path in tmp_path.glob("*/*.log"))
    assert logs.count("is of another metric than save_best (loss/figure)") == 1


def test_a_checkpoint_names_no_file_that_its_training_removes(tmp_path):
    learn(tmp_path / "run", 2, save_best="figure", rule="greater")
    precious, best = tmp_path / "keys", tmp_path / "run/best_figure_epoch_2.pth"
    precious.write_text("mine")
    (tmp_path / "run/best_figure_epoch_1.pth").symlink_to(precious)
    for named in (
        str(precious), str(tmp_path / "run/../keys"), str(tmp_path / "run/epoch_1.pth"),
        str(tmp_path / "run/best_figure_epoch_1.pth"), 5,
    ):  # fmt: skip
        content = torch.load(tmp_path / "run/epoch_2.pth", weights_only=False)
        content["message_hub"]["runtime_info"] |= {"best_ckpt": named, "best_score": -1.0}
        torch.save(content, tmp_path / "run/foreign.pth")
        learn(tmp_path / "run", 3, tmp_path / "run/foreign.pth", save_best="figure", rule="greater")
        assert precious.read_text() == "mine"
        assert (tmp_path / "run/epoch_1.pth").exists()
        assert best.exists()
    earlier = tmp_path / "run/best_figure_epoch_1.pth"
    earlier.unlink()
    earlier.write_bytes(best.read_bytes())
    content["message_hub"]["runtime_info"]["best_ckpt"] = str(earlier)
    torch.save(content, tmp_path / "run/own.pth")
    learn(tmp_path / "run", 3, tmp_path / "run/own.pth", save_best="figure", rule="greater")
    assert not earlier.exists()  # the run's own, which a better one has followed


@pytest.mark.parametrize("kind", ["link", "hard", "pipe"])
def test_the_name_of_the_newest_checkpoint_is_written_to_no_other_file(kind, tmp_path):
    keys, name = tmp_path / "keys", tmp_path / "run/last_checkpoint"
    keys.write_text("mine")
    name.parent.mkdir()
    if kind == "link":
        name.symlink_to(keys)
    elif kind == "hard":
        os.link(keys, name)
    else:
        os.mkfifo(name)
    learn(tmp_path / "run", 1)
    assert keys.read_text() == "mine"
    assert name.read_text() == str(tmp_path / "run/epoch_1.pth")


def test_a_checkpoint_holds_the_models_settings_and_no_text_that_runs(tmp_path):
    learn(tmp_path, 1)
    settings = read_checked(tmp_path / "epoch_1.pth").settings
    assert settings == {"type": "Learner", "size": [1, 2]}
    poisoned = torch.load(tmp_path / "epoch_1.pth", weights_only=False)
    poisoned["meta"]["config"] = f"open({str(tmp_path / 'proof')!r}, 'w')"
    torch.save(poisoned, tmp_path / "epoch_1.pth")
    learn(tmp_path, 2, tmp_path / "epoch_1.pth")
    assert not (tmp_path / "proof").exists()


class Sized(list):
    """Samples of a data set whose scaled images have a size."""

    def __init__(self, width: int | None, *, signals: bool = True):
        super().__init__([{"inputs": torch.ones(1)}])
        self.scaled_image_size = lambda: width and (width, 9)
        self.has_signals = lambda: signals


def test_the_images_of_several_data_sets_are_noted_if_they_agree(tmp_path):
    equal = ConcatDataset([Sized(16), ConcatDataset([Sized(16)])])
    learn(tmp_path / "equal", 1, train=equal)
    checkpoint = read_checked(tmp_path / "equal/epoch_1.pth")
    assert checkpoint.image_size == (16, 9)
    assert checkpoint.can_bus
    learn(tmp_path / "none", 1, train=Sized(None))  # LiDAR alone
    assert read_checked(tmp_path / "none/epoch_1.pth").image_size is None
    learn(tmp_path / "mixed", 1, train=ConcatDataset([Sized(16), Sized(32, signals=False)]))
    checkpoint = read_checked(tmp_path / "mixed/epoch_1.pth")
    assert checkpoint.image_size is None
    assert checkpoint.can_bus
    log = next((tmp_path / "mixed").glob("*/*.log")).read_text()
    assert "images of 16 x 9 and 32 x 9 pixels, so the checkpoints store no size" in log
    assert "Some training data sets have vehicle signals and others have none" in log
