"""How a command ends: with a report, an error in words, interrupted, or a traceback."""

import os
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from processes import run_python

from gsmap.utils.cli import CommandParser, EachOnce, output_file, run_command
from gsmap.utils.errors import InputError, InputTypeError, NotFiniteError, WorkError
from gsmap.utils.files import atomic_write, read_json, read_text, write_text
from gsmap.utils.parallel import ordered_map


class DamagedError(InputError):
    """An error of a kind of its own."""


def test_a_report_is_printed(capsys):
    run_command(lambda: "3 samples")
    run_command(lambda: None)
    assert capsys.readouterr().out == "3 samples\n"


def fail(error: Exception) -> None:
    raise error


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (InputError("no such split"), "no such split"),
        (InputTypeError("grid must be a BEVGrid"), "grid must be a BEVGrid"),
        (NotFiniteError("losses are not finite"), "losses are not finite"),
        (WorkError("a worker\n  died"), "a worker died"),
        (DamagedError("sample 'a': damaged"), "sample 'a': damaged"),
        (
            OSError(28, "No space left on device"),
            "[Errno 28] No space left on device; free some space there, or write elsewhere.",
        ),
        (
            PermissionError(13, "Permission denied", "a"),
            "[Errno 13] Permission denied: 'a'; choose a place that you may read and write.",
        ),
    ],
)
def test_what_a_check_says_is_one_line_and_2(error, line, capsys):
    with pytest.raises(SystemExit) as left:
        run_command(lambda: fail(error))
    assert left.value.code == 2
    assert capsys.readouterr().err == f"error: {line}\n"


def test_files_of_the_user_end_in_words(tmp_path, capsys):
    (tmp_path / "a.json").write_text("{")
    (tmp_path / "b.txt").write_bytes(b"\xff")
    (tmp_path / "d.json").write_text("[" * 100_000)
    for read in (
        lambda: read_json(tmp_path / "a.json"),
        lambda: read_text(tmp_path / "b.txt"),
        lambda: (tmp_path / "c.txt").read_text(),
        lambda: read_json(tmp_path / "d.json"),
    ):
        with pytest.raises(SystemExit):
            run_command(read)
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(":")[0] for line in lines] == ["error"] * 4
    assert "a.json cannot be read: Expecting property name" in lines[0]
    assert "b.txt cannot be read: 'utf-8' codec can't decode byte" in lines[1]
    assert "c.txt'; check the path." in lines[2]
    assert "d.json cannot be read: it is nested too deep." in lines[3]


def full_disk() -> None:
    write_text("/dev/full", "x")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_is_one_line(capsys):
    with pytest.raises(SystemExit):
        run_command(full_disk)
    assert capsys.readouterr().err == (
        "error: [Errno 28] No space left on device: '/dev/full'; free some space there, or write "
        "elsewhere.\n"
    )


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_full_disk_in_a_thread_is_one_line_too(capsys, monkeypatch):
    def log() -> None:
        thread = threading.Thread(target=full_disk)
        thread.start()
        thread.join()

    monkeypatch.setattr(threading, "excepthook", threading.excepthook)  # put back afterwards
    run_command(log)
    error = capsys.readouterr().err
    assert error.startswith("error: [Errno 28] No space left on device: '/dev/full'; free some")
    assert error.count("\n") == 1


def bad_check(text: str) -> None:
    raise InputError(f"text must be a number, got {text}.")


def test_an_error_in_a_block_leaves_no_half_written_file(tmp_path, capsys):
    def write() -> None:
        with atomic_write(tmp_path / "a") as file:
            file.write("half")
            raise InputError("not whole")

    with pytest.raises(SystemExit):
        run_command(write)
    assert capsys.readouterr().err == "error: not whole\n"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("slip", "kind"),
    [
        (lambda: {}["key"], KeyError),
        (lambda: len(1), TypeError),
        (lambda: float("x"), ValueError),
        (lambda: [][1], IndexError),
        (lambda: fail(AssertionError()), AssertionError),
        (lambda: None.nothing, AttributeError),
        (lambda: fail(ValueError("by a library")), ValueError),
        (lambda: fail(RuntimeError("by a library")), RuntimeError),
    ],
)
def test_a_slip_in_the_code_keeps_its_traceback(slip, kind):
    with pytest.raises(kind):
        run_command(slip)


def look_up(key: str) -> None:
    {}[key]


def in_worker(function, argument) -> None:
    list(ordered_map(function, [argument], workers=2))


def test_every_traceback_can_be_had(monkeypatch):
    monkeypatch.setenv("GSMAP_TRACEBACK", "1")
    with pytest.raises(ValueError, match="no such split"):
        run_command(lambda: fail(InputError("no such split")))


def test_where_a_command_is_to_write_is_checked_before_its_work(tmp_path):
    (tmp_path / "file").touch()
    assert output_file(str(tmp_path / "new/a.json")) == tmp_path / "new/a.json"
    assert output_file("/dev/null") == Path("/dev/null")
    with pytest.raises(IsADirectoryError, match=re.escape(repr(str(tmp_path)))):
        output_file(str(tmp_path))
    with pytest.raises(NotADirectoryError, match="/file'"):
        output_file(str(tmp_path / "file/a.json"))


@pytest.mark.faults
def test_errors_of_workers_are_told_apart_too(capsys):
    with pytest.raises(SystemExit):
        run_command(lambda: in_worker(bad_check, "x"))
    assert capsys.readouterr().err == "error: text must be a number, got x.\n"
    with pytest.raises(KeyError):
        run_command(lambda: in_worker(look_up, "x"))


def test_ctrl_c_is_one_line_and_130(capsys):
    def interrupted() -> None:
        raise KeyboardInterrupt

    with pytest.raises(SystemExit) as left:
        run_command(interrupted)
    assert left.value.code == 130
    assert capsys.readouterr().err == "interrupted: nothing half-written is left\n"


@pytest.mark.faults
def test_impatience_does_not_cut_the_clean_up_off(tmp_path):
    """Ctrl-C, five times: the half-written file goes all the same, and there is one line."""
    program = f"""
import os, signal, time
from gsmap.utils import cli, signals
from gsmap.utils.files import atomic_write
signals.CLEAN_UP_S = 600.0
signal.signal(signal.SIGINT, signal.default_int_handler)  # these tests may run in the background
unlink = os.unlink
def slowly(path):
    print("cleaning", flush=True)
    input()
    unlink(path)
os.unlink = slowly
def command():
    with atomic_write({str(tmp_path / "a")!r}):
        print("ready", flush=True)
        while True:
            time.sleep(0.05)
cli.run_command(command)
"""
    with subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    ) as process:  # fmt: skip
        assert process.stdout.readline() == b"ready\n"
        process.send_signal(signal.SIGINT)
        assert process.stdout.readline() == b"cleaning\n"
        for _ in range(4):
            process.send_signal(signal.SIGINT)
        _, said = process.communicate(b"done\n")
        assert process.returncode == 130
        assert said == b"interrupted: nothing half-written is left\n"
    assert os.listdir(tmp_path) == []


@pytest.mark.faults
@pytest.mark.parametrize(("clean_up_on_kill", "code", "left"), [(True, 143, 0), (False, -15, 1)])
def test_kill_runs_the_clean_up_where_that_is_wanted(clean_up_on_kill, code, left, tmp_path):
    program = f"""
import time
from gsmap.utils.cli import CommandParser, output_file, run_command
from gsmap.utils.errors import InputError, InputTypeError, NotFiniteError, WorkError
from gsmap.utils.files import atomic_write
def command():
    with atomic_write({str(tmp_path / "a")!r}):
        print("ready", flush=True)
        while True:
            time.sleep(0.05)
run_command(command, clean_up_on_kill={clean_up_on_kill})
"""
    with subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdout.readline() == b"ready\n"
        process.send_signal(signal.SIGTERM)
        assert process.wait() == code
        assert process.stderr.read() == b""
    assert len(os.listdir(tmp_path)) == left


def test_ctrl_c_that_arrives_while_an_error_is_told_is_one_line(capsys, monkeypatch):
    """A rank in a collective hears of its peers' end before it can heed the signal itself."""

    class PeerError(InputError):
        def __str__(self) -> str:
            signal.raise_signal(signal.SIGINT)
            return "closed by peer"

    monkeypatch.delenv("RANK", raising=False)
    before = signal.getsignal(signal.SIGINT)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(SystemExit) as left:
            run_command(lambda: fail(PeerError()))
    finally:
        signal.signal(signal.SIGINT, before)
    assert left.value.code == 130
    assert capsys.readouterr().err == "interrupted: nothing half-written is left\n"


@pytest.mark.faults
@pytest.mark.parametrize(
    ("end", "code", "said"),
    [
        ("return 'done'", 0, ""),
        ("raise InputError('no such split')", 2, "error: no such split\n"),
        ("sys.exit(3)", 3, ""),
        ("sys.exit('stopped')", 1, "stopped\n"),
        ("1 / 0", 1, "ZeroDivisionError: division by zero\n"),
    ],
)
def test_a_rank_ends_without_the_end_of_the_interpreter(end, code, said):
    """Threads of gloo may abort the process there, or stop it for good."""
    program = f"""
import atexit, ctypes, sys, threading
from gsmap.utils.cli import run_command
from gsmap.utils.errors import InputError
abort = ctypes.cast(ctypes.CDLL(None).abort, ctypes.c_void_p)
assert ctypes.pythonapi.Py_AtExit(abort) == 0
atexit.register(sys.stdout.write, "exit function")
def write():
    threading.main_thread().join()
    sys.stdout.write("thread, ")
def command():
    threading.Thread(target=write).start()
    {end}
run_command(command, clean_up_on_kill=False)
"""
    done = run_python("-c", program, env={"RANK": "0"})
    assert done.returncode == code
    assert done.stderr.endswith(said)
    assert bool(done.stderr) == bool(said)
    printed = "done\n" if code == 0 else ""
    assert done.stdout == f"{printed}thread, exit function"


@pytest.mark.faults
def test_ctrl_c_is_one_line_with_forked_workers_and_none_from_other_ranks(tmp_path):
    """A terminal sends it to the whole group: workers of a data loader, all ranks of a machine."""
    program = """
import os, signal, time
from gsmap.utils.cli import run_command
signal.signal(signal.SIGINT, signal.default_int_handler)  # these tests may run in the background
def command():
    if os.fork() == 0:
        while True:
            signal.pause()  # it dies with its parent
    print("ready", flush=True)  # by the parent: Python ignores what is raised at the end of a fork
    while True:
        time.sleep(0.05)
run_command(command, clean_up_on_kill=False)
"""
    for rank, said in (("0", b"interrupted: nothing half-written is left\n"), ("1", b"")):
        with subprocess.Popen(
            [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            env={**os.environ, "RANK": rank}, start_new_session=True,
        ) as process:  # fmt: skip
            assert process.stdout.readline() == b"ready\n"
            os.killpg(process.pid, signal.SIGINT)
            assert process.wait() == 130
            assert process.stderr.read() == said


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["chekc"], "invalid choice: 'chekc' (choose from 'check'); did you mean 'check'?"),
        (["check", "--data-rot", "x"], "--data-rot x; did you mean '--data-root'?"),
        (["check", "-q", "--data-rot=5"], "-q --data-rot=5; did you mean '--data-root'?"),
        (["--formats", "geojsn"], "; did you mean 'geojson'?"),
        (["check", "--level", "3"], "invalid choice: 3 (choose from 1, 2)\n"),
        (["check", "-q"], "unrecognized arguments: -q\n"),
    ],
)
def test_similar_options_and_choices_are_named(words, message, capsys):
    parser = CommandParser()
    parser.add_argument("--formats", choices=("osm", "geojson"), nargs="+")
    subparser = parser.add_subparsers(dest="command").add_parser("check")
    subparser.add_argument("--data-root")
    subparser.add_argument("--level", type=int, choices=(1, 2))
    with pytest.raises(SystemExit, match="2"):
        parser.parse_args(words)
    assert message in capsys.readouterr().err


def test_a_word_that_is_given_twice_counts_once():
    parser = CommandParser()
    parser.add_argument("--formats", nargs="+", action=EachOnce, default=["png"])
    assert parser.parse_args([]).formats == ["png"]
    assert parser.parse_args(["--formats", "osm", "png", "osm"]).formats == ["osm", "png"]


@pytest.mark.parametrize("text", ["x" * 300, "a/" * 3000, "a\0b", "", "PROJCS[é" * 40])
def test_a_text_of_any_length_is_an_argument(text):
    parser = CommandParser()
    parser.add_argument("--crs")
    assert parser.parse_args(["--crs", text]).crs == text
