"""Kills at any moment, those around a rename among them, and two writers at once."""

import os
import signal
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from processes import REPO, run_python

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.engine.checkpoint_hook import AtomicLocalBackend
from gsmap.evaluation.core.results_json import RESULTS_KEY, read_samples, write_results
from gsmap.utils.files import SUFFIX
from mapdata.nuscenes.convert import NuScenesOptions, convert_nuscenes

pytestmark = pytest.mark.faults

SPLITS = [f"gsmap_minicity_{split}.arrow" for split in ("train", "val")]


def convert(root: Path, out: Path) -> None:
    convert_nuscenes(NuScenesOptions(root, "v1.0-trainval", dataset="minicity", out_dir=out))


def save(_: Path, out: Path) -> None:
    AtomicLocalBackend().put(b"whole" * 1000, out / "epoch_1.pth")


def score(_: Path, out: Path) -> None:
    write_results(out / "results.json", [("a", []), ("b", [])])


def check(out: Path) -> list[str]:
    """Read each file that has its name, and return these names."""
    found = sorted(path.name for path in out.iterdir() if path.suffix != SUFFIX)
    for name in found:
        if name.endswith(".arrow"):
            assert len(list(AnnotationFile(out / name))) == 2
        elif name.endswith(".json"):
            assert len(read_samples(out / name, RESULTS_KEY, ("a",))[0]) == 2
        else:
            assert (out / name).read_bytes() == b"whole" * 1000
    return found


def started(work: Callable[[], None]) -> int:
    """Do some work in a forked process; return its number."""
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            work()
            code = 0
        finally:
            os._exit(code)
    return pid


def dying_at_rename(number: int, after: bool, work: Callable[[], None]) -> None:
    """Do some work, and die right before or after a rename."""
    replace, seen = os.replace, []

    def watched(*paths: str) -> None:
        seen.append(paths)
        if len(seen) <= number or after:
            replace(*paths)
        if len(seen) > number:
            os.kill(os.getpid(), signal.SIGKILL)

    os.replace = watched
    work()


@pytest.mark.parametrize(
    ("work", "names"), [(convert, SPLITS), (save, ["epoch_1.pth"]), (score, ["results.json"])]
)
def test_a_kill_around_a_rename_leaves_whole_files_and_the_next_run_tidies_up(
    work, names, minicity_root, tmp_path
):
    for number in range(len(names)):
        for after in (False, True):
            out = tmp_path / f"{number}{after}"
            out.mkdir()
            ready = partial(work, minicity_root, out)
            _, status = os.waitpid(started(partial(dying_at_rename, number, after, ready)), 0)
            assert os.WTERMSIG(status) == signal.SIGKILL
            assert len(check(out)) == number + after
            assert len(list(out.iterdir())) == len(names)  # the others are left, half-named
            ready()
            assert sorted(os.listdir(out)) == check(out) == names


def test_a_kill_at_any_moment_of_a_conversion_leaves_whole_files(minicity_root, tmp_path):
    begun = time.monotonic()
    convert(minicity_root, tmp_path / "whole")
    lasts_s = time.monotonic() - begun
    for moment in range(6):
        pid = started(partial(convert, minicity_root, tmp_path / "killed"))
        time.sleep(lasts_s * moment / 5)
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        if (tmp_path / "killed").exists():
            check(tmp_path / "killed")
    convert(minicity_root, tmp_path / "killed")
    assert sorted(os.listdir(tmp_path / "killed")) == check(tmp_path / "killed") == SPLITS


def test_two_conversions_at_once_make_what_one_makes(minicity_root, tmp_path):
    one, both = tmp_path / "one", tmp_path / "both"
    convert(minicity_root, one)
    pids = [started(partial(convert, minicity_root, both)) for _ in range(2)]
    assert [os.waitpid(pid, 0)[1] for pid in pids] == [0, 0]
    assert sorted(os.listdir(both)) == SPLITS
    for name in SPLITS:
        assert (both / name).read_bytes() == (one / name).read_bytes()


@pytest.mark.timeout(1800)  # several trainings
def test_commands_that_are_killed_leave_what_they_leave_unkilled(
    minicity_root, minicity_annotations, tiny_config
):
    """A part of ``python -m fuzz.kills``."""
    paths = [str(REPO), str(REPO / "tests"), str(REPO / "tools"), os.environ.get("PYTHONPATH", "")]
    done = run_python(
        "-m", "fuzz.kills", "--kills", 2, "--data", minicity_root, tiny_config,
        env={"PYTHONPATH": os.pathsep.join(paths)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert [line.split("|")[3:5] for line in done.stdout.splitlines()[2:]] == [[" 2 ", " 2 "]] * 4
