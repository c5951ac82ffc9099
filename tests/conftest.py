"""Fixtures shared by all tests."""

import ctypes
import gc
import os
import platform
import random
from collections.abc import Generator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, settings
from mmengine.dataset import base_dataset
from parsed_configs import keep_parsed_configs, leave_configs_unformatted

import gsmap  # noqa: F401 - before mmcv.ops, which may need its stand-in

REPO = Path(__file__).resolve().parents[1]

if os.environ.pop("PYTHONDONTWRITEBYTECODE", None):
    # A new process that imports mmdet compiles 900 modules, if none before it has left them
    os.environ["PYTHONPYCACHEPREFIX"] = str(REPO / ".pytest_cache/bytecode")

if platform.machine() == "x86_64":
    # Equal instructions on each machine: with AVX-512, sums are rounded otherwise. This flips cells
    # of PivotNet's thresholded attention masks and moves MapQR's samples, more than the golden
    # quantities allow. torch, MKL and oneDNN read these when they first compute. If oneDNN used AMX
    # and torch AVX2, torch's attention in bfloat16 would raise.
    os.environ["ATEN_CPU_CAPABILITY"] = "avx2"
    os.environ["MKL_ENABLE_INSTRUCTIONS"] = "AVX2"
    os.environ["ONEDNN_MAX_CPU_ISA"] = "AVX512_CORE_BF16"

# The same examples each time, however slow the machine is
settings.register_profile(
    "steady", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("steady")
keep_parsed_configs()
leave_configs_unformatted()
# Each data set that is built would search all objects of the process
base_dataset.gc = SimpleNamespace(collect=lambda: 0)

# Collections are a fifteenth of the time of an export; now they come a tenth as often
gc.set_threshold(7_000, 10, 10)

HAS_GPU = torch.cuda.is_available()
TRIM = getattr(ctypes.CDLL(None), "malloc_trim", None)
STATM = Path("/proc/self/statm")
PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
resident = {"bytes": 0}  # after the last trim


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--count", type=int, default=1, help="run each test so many times")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Make further cases of a test that is to be run several times."""
    count = metafunc.config.getoption("count")
    if count > 1:
        metafunc.fixturenames.append("repetition")
        metafunc.parametrize("repetition", range(count), indirect=True)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Import the tests and all that they import without garbage collections.

    What they bring lives as long as the process, so that later collections leave it out, too: each
    would search a million objects.
    """
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.fixture
def repetition(request: pytest.FixtureRequest) -> int:
    """Which of the repetitions of ``--count`` this is."""
    return request.param


def pytest_runtest_setup() -> None:
    """Give each test, and fixtures that are made for it, one seed."""
    random.seed(0)
    np.random.seed(0)  # noqa: NPY002 - of libraries
    torch.default_generator.manual_seed(0)
    if HAS_GPU:  # without one, `torch.manual_seed` takes longer than most tests
        torch.cuda.manual_seed_all(0)


def pytest_runtest_logfinish() -> None:
    """Give memory that a test has freed back to the system.

    glibc keeps freed blocks of up to 32 MB: gigabytes after a step of a large model. To keep none
    at all (``M_MMAP_THRESHOLD``) costs a third of such a step.
    """
    if TRIM is None or not STATM.exists():
        return
    if _resident_bytes() > resident["bytes"] + (1 << 28):
        gc.collect()
        TRIM(0)
        resident["bytes"] = _resident_bytes()


def _resident_bytes() -> int:
    return int(STATM.read_text().split()[1]) * PAGE_BYTES


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """Folder with reference data outside the project (``GSMAP_SHARED``); skips without it."""
    path = Path(os.environ.get("GSMAP_SHARED", REPO.parent / "shared"))
    if not path.is_dir():
        pytest.skip(f"no reference data at {path}: set GSMAP_SHARED")
    return path


@pytest.fixture(scope="session")
def golden_dir(shared_dir: Path) -> Path:
    """Reference inputs and outputs of earlier systems."""
    return shared_dir / "golden"


@pytest.fixture(scope="session")
def minicity_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny MiniCity: two scenes (train, val) of two samples, six cameras of 400 x 225."""
    from minicity.generate import generate

    root = tmp_path_factory.mktemp("minicity") / "root"
    generate(
        root=root,
        scenes=2,
        seed=0,
        image_size=(400, 225),
        samples_per_scene=2,
        sweeps_per_sample=1,
        val_scenes=1,
        workers=1,
    )
    return root


@pytest.fixture(scope="session")
def minicity_annotations(minicity_root: Path) -> dict[str, Path]:
    """The annotation files of ``minicity_root`` by split, in its root."""
    from mapdata.nuscenes.convert import NuScenesOptions, convert_nuscenes

    convert_nuscenes(NuScenesOptions(minicity_root, "v1.0-trainval", dataset="minicity"))
    return {split: minicity_root / f"gsmap_minicity_{split}.arrow" for split in ("train", "val")}


TINY_CONFIG = """
_base_ = '{repo}/projects/GSMap/configs/gsmap_maptr_r18_minicity.py'
_data = dict(data_root='{root}')
_heads = dict(num_heads=4, ffn_dims=16)
model = dict(
    img_backbone=dict(base_channels=8),
    img_neck=dict(in_channels=[16, 32, 64], out_channels=[8, 4, 4]),
    bev_encoder=dict(embed_dims=16, layer_cfg=dict(num_heads=4, ffn_dims=16)),
    map_head=dict(
        embed_dims=16, query_groups=[dict(num=5)], decoder=dict(num_layers=2, layer=_heads)))
train_dataloader = dict(batch_size=1, num_workers=0, persistent_workers=False, dataset=_data)
val_dataloader = dict(num_workers=0, persistent_workers=False, dataset=_data)
test_dataloader = dict(num_workers=0, persistent_workers=False, dataset=_data)
train_cfg = dict(max_epochs=3, val_interval=9)
param_scheduler = []
default_hooks = dict(logger=dict(interval=1))
"""


@pytest.fixture(scope="session")
def tiny_config(minicity_root: Path, minicity_annotations, tmp_path_factory) -> Path:
    """A config of a very small GSMap on a very small MiniCity."""
    target = tmp_path_factory.mktemp("config") / "tiny.py"
    target.write_text(TINY_CONFIG.format(repo=REPO, root=f"{minicity_root}/"))
    return target


@pytest.fixture(scope="session")
def small_onnx(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The exported file of a tiny GSMap with one decoder layer."""
    from export_cases import export_once
    from model_cases import small_config

    head = {**small_config()["map_head"], "type": "GSMapHead", "masks": {"pixel_m": 1.5}}
    head["decoder"] = {**head["decoder"], "num_layers": 1}
    return export_once(tmp_path_factory, "small.onnx", map_head=head)


@pytest.fixture(scope="session")
def stream_onnx(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The exported file of a tiny MapTR that remembers features of the map and queries."""
    from export_cases import export_once

    memory = {"bev": {}, "queries": {"num": 3}, "embed_dims": 16}
    return export_once(tmp_path_factory, "stream.onnx", temporal=memory)


@pytest.fixture
def poisoned_empty(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fill every new tensor that a kernel is to write with NaN."""
    for name in ("empty", "empty_like"):
        original = getattr(torch, name)

        def poisoned(*args, original=original, **kwargs):
            result = original(*args, **kwargs)
            if result.is_floating_point():
                result.detach().fill_(torch.nan)  # also a leaf that wants a gradient
            return result

        monkeypatch.setattr(torch, name, poisoned)
