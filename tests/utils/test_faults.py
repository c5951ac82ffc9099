"""What exceptions say to a user: the machine's, a file's, a config's, a data loader's worker's."""

import errno
import os
import signal
from pathlib import Path

import pyarrow as pa
import pytest
import torch
from mmdet3d.registry import DATA_SAMPLERS
from mmengine import Registry
from mmengine.config import Config
from torch.utils.data import DataLoader

from gsmap.checkpoints.building import building
from gsmap.checkpoints.reading import refusing
from gsmap.datasets.errors import explain_errors
from gsmap.utils.errors import InputError, WorkError
from gsmap.utils.faults import is_machine_error, user_message

PARTS = Registry("part")


@PARTS.register_module()
class Wheel:
    """A part with one setting of its own and one of its base."""

    def __init__(self, radius_m: float = 0.5, axle: dict | None = None):
        if radius_m <= 0:
            raise ValueError(f"radius_m must be > 0, got {radius_m}.")
        self.area = radius_m**2
        self.axle = axle and PARTS.build(axle)


@PARTS.register_module()
class Tyre(Wheel):
    def __init__(self, width_m: float = 0.2, **kwargs):
        super().__init__(**kwargs)


def said(command) -> str | None:
    """Return what a command that fails says."""
    try:
        command()
    except Exception as error:
        return user_message(error)
    raise AssertionError("nothing failed")


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"type": "Tire"}, "there is no part of type 'Tire'; did you mean 'Tyre'?"),
        ({"type": "Zzz"}, "there is no part of type 'Zzz'."),
        ({"type": "Tyre", "with_m": 1}, "has no setting 'with_m'; did you mean 'width_m'?"),
        ({"type": "Tyre", "radus_m": 1}, "has no setting 'radus_m'; did you mean 'radius_m'?"),
        ({"type": "Wheel", "radius_m": -1}, "radius_m must be > 0, got -1."),
        (
            {"type": "Wheel", "axle": {"type": "Wheel", "radius_m": []}},
            "Wheel of Wheel cannot be made from these settings: TypeError: '<=' not supported "
            "between instances of 'list' and 'int' (GSMAP_TRACEBACK=1 shows where).",
        ),
    ],
)
def test_settings_that_nothing_can_be_made_of(settings, text):
    def build() -> None:
        with building(Config()):
            PARTS.build(settings)

    assert said(build).endswith(text)


def test_a_registry_may_have_a_name_of_two_words():
    text = r"^there is no data sampler of type 'Zzz'\.$"
    with pytest.raises(InputError, match=text), building(Config()):
        DATA_SAMPLERS.build({"type": "Zzz"})


@PARTS.register_module()
class Spoke:
    """A part that raises an error."""

    def __init__(self, error: Exception):
        raise error


@pytest.fixture
def bike(tmp_path, monkeypatch) -> Config:
    """A config from a file, with an empty model."""
    monkeypatch.chdir(tmp_path)
    Path("bike.py").write_text("model = dict()")
    return Config.fromfile("bike.py")


@pytest.mark.parametrize(
    ("error", "raised", "text"),
    [
        (InputError("no radius."), InputError, "bike.py: no radius."),
        (WorkError("no GPU."), WorkError, "bike.py: no GPU."),
        (InputError("no file a/b."), InputError, "no file a/b."),
        (ValueError("no radius."), InputError, "bike.py: Spoke cannot be made from these settings"),
        (KeyError("radius"), InputError, "bike.py: Spoke cannot be made from these settings: Key"),
        (FileNotFoundError("no file a/b."), FileNotFoundError, "no file a/b."),
        (MemoryError(), MemoryError, "out of memory"),
    ],
)
def test_an_error_of_a_part_names_the_config_once(error, raised, text, bike):
    with pytest.raises(raised) as caught, building(bike), building(bike):
        PARTS.build({"type": "Spoke", "error": error})
    assert type(caught.value) is raised
    assert user_message(caught.value).startswith(text)


def test_a_bug_beside_the_parts_stays_a_bug():
    with pytest.raises(ValueError, match="could not convert") as caught, building(Config()):
        float("x")
    assert user_message(caught.value) is None


def test_a_setting_that_is_missing(bike):
    text = r"^bike\.py: a setting is missing: .*wheels"
    with pytest.raises(InputError, match=text), building(bike):
        bike.model.wheels.radius_m = 1


@pytest.mark.parametrize("kind", [MemoryError, RuntimeError, torch.OutOfMemoryError])
def test_want_of_memory_says_what_to_lower(kind):
    def work() -> None:
        raise kind("CUDA out of memory. Tried to allocate 2 GiB\nand much more")

    assert said(work) == (
        "out of memory (CUDA out of memory. Tried to allocate 2 GiB): take a smaller batch "
        "(train_dataloader.batch_size=1), fewer processes (num_workers, --workers) or smaller "
        "images."
    )


def test_more_memory_than_there_is():
    assert said(lambda: torch.empty(1 << 50)).startswith("out of memory (")


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
@pytest.mark.parametrize("device", ["cuda", "cuda:7"])
def test_a_device_that_is_not_there(device):
    text = said(lambda: torch.zeros(1).to(device))
    assert text.startswith("this machine does not have the device that was asked for (")
    assert text.endswith("): give cpu.")


class Broken(torch.utils.data.Dataset):
    """A data set whose samples end as it is told."""

    def __init__(self, error: Exception | None):
        self.error = error

    def __len__(self) -> int:
        return 1

    def __getitem__(self, index: int) -> int:
        if self.error is None:
            return {}[index]
        raise self.error


@pytest.mark.faults
@pytest.mark.parametrize(
    ("error", "text"),
    [
        (InputError("sample 'a': no image at b.jpg"), "sample 'a': no image at b.jpg"),
        (ValueError("no check of ours"), None),
        (FileNotFoundError("no file c.jpg"), "no file c.jpg"),
        (None, None),
    ],
)
def test_a_worker_of_a_data_loader_says_what_it_met(error, text):
    assert said(lambda: next(iter(DataLoader(Broken(error), num_workers=1)))) == text


class Shortened(torch.utils.data.Dataset):
    """A data set whose file ends before the memory that it is mapped to."""

    def __len__(self) -> int:
        return 1

    def __getitem__(self, index: int) -> None:
        os.kill(os.getpid(), signal.SIGBUS)


@pytest.mark.faults
def test_a_bus_error_of_a_worker_is_no_want_of_memory():
    text = said(lambda: next(iter(DataLoader(Shortened(), num_workers=1))))
    assert not text.startswith("out of memory")  # torch misses the signal now and then
    assert "a data file was shortened while" in text


@pytest.mark.parametrize(
    ("cause", "text"),
    [
        ("pid 7) is killed by signal: Bus error.", "bus error of a data loader's worker: a data"),
        ("pid 7) is killed by signal: Killed.", "out of memory (DataLoader worker (pid(s) 7) exi"),
        ("", "DataLoader worker (pid(s) 7) exited unexpectedly, and its signal is unknown:"),
    ],
)
def test_the_signal_of_a_worker_says_what_was_missing(cause, text):
    def end():
        raise RuntimeError("DataLoader worker (pid(s) 7) exited unexpectedly") from OSError(cause)

    assert said(end).startswith(text)


@pytest.mark.parametrize(
    ("error", "of_machine"),
    [
        (MemoryError(), True),
        (pa.ArrowMemoryError("malloc of size 64 failed"), True),
        (OSError(errno.EMFILE, "Too many open files"), True),
        (PermissionError(errno.EACCES, "Permission denied"), True),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried 4 bytes"), True),
        (OSError(errno.EINVAL, "Invalid argument"), False),
        (OSError("Expected to read 4 bytes, got 2"), False),
        (RuntimeError("PytorchStreamReader failed reading zip archive"), False),
        (ValueError("cannot allocate memory"), False),
    ],
)
def test_a_file_is_not_to_blame_for_what_the_machine_lacks(error, of_machine):
    assert is_machine_error(error) == of_machine
    for reading in (refusing("a.pth"), explain_errors("a.json", "copy it again")):
        with pytest.raises(type(error) if of_machine else Exception) as raised, reading:
            raise error
        assert not of_machine or raised.value is error
