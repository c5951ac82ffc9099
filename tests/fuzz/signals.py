"""What is left of a command some seconds after it was ended, whatever ended it.

``PYTHONPATH=tests python -m fuzz.signals --data MINICITY CONFIG`` prints a table.
"""

import argparse
import ctypes
import os
import re
import select
import shutil
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

COMMANDS = "check", "evaluate", "infer", "train, two ranks"
BY_SIGNAL = {signal.SIGINT: 130, signal.SIGTERM: 143, signal.SIGHUP: 129, signal.SIGKILL: -9}


def ctrl_c(pid: int, terminal: int) -> int:
    os.write(terminal, b"\x03")
    return terminal


def ctrl_c_twice(pid: int, terminal: int) -> int:
    ctrl_c(pid, terminal)
    time.sleep(0.3)
    return ctrl_c(pid, terminal)


def kill(pid: int, terminal: int) -> int:
    os.kill(pid, signal.SIGTERM)
    return terminal


def kill_9(pid: int, terminal: int) -> int:
    os.kill(pid, signal.SIGKILL)
    return terminal


def close_terminal(pid: int, terminal: int) -> int:
    os.close(terminal)
    return -1


ENDS: dict[str, tuple[Callable[[int, int], int], int]] = {
    "Ctrl-C": (ctrl_c, signal.SIGINT),
    "Ctrl-C twice": (ctrl_c_twice, signal.SIGINT),
    "kill": (kill, signal.SIGTERM),
    "kill -9": (kill_9, signal.SIGKILL),
    "terminal closed": (close_terminal, signal.SIGHUP),
}


def descendants() -> dict[int, str]:
    """Return the living processes below this one by number; orphans come back to it."""
    parents, names = {}, {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            text = stat.read_text()
        except (FileNotFoundError, ProcessLookupError):
            continue
        state, parent = text[text.rindex(")") + 2 :].split()[:2]
        pid = int(stat.parent.name)
        parents[pid] = int(parent)
        if state not in "ZX":
            names[pid] = f"{pid} {text[text.index('(') : text.rindex(')') + 1]} {state}"
    own = {os.getpid()}
    while more := {pid for pid, parent in parents.items() if parent in own} - own:
        own |= more
    return {pid: name for pid, name in names.items() if pid in own and pid != os.getpid()}


def read_some(terminal: int) -> str:
    """Read what a command says, so that it does not wait for a reader."""
    if terminal < 0 or not select.select([terminal], [], [], 0.05)[0]:
        time.sleep(0.05)
        return ""
    try:
        return os.read(terminal, 10000).decode(errors="replace")
    except OSError:  # all have left the terminal
        return ""


def last_words(pids: list[int], terminal: int) -> str:
    """End processes that did not end, and return where their threads stood (`faulthandler`)."""
    for pid in pids:
        os.kill(pid, signal.SIGABRT)
    said, begun_s = "", time.monotonic()
    while any(pid in descendants() for pid in pids) and time.monotonic() < begun_s + 10:
        said += read_some(terminal)
    for pid in descendants():
        os.kill(pid, signal.SIGKILL)
    return said


def case(name: str, end: str, data: "Data", limit_s: float) -> str:  # noqa: F821
    """Start a command, end it in the midst of its work, and say what is wrong then."""
    from fuzz.commands import start

    out = data.empty_folder()
    pid, terminal = start(data.commands(out)[name])
    said = ""
    while not at_work(name, said, out):
        said += read_some(terminal)
        if os.waitpid(pid, os.WNOHANG)[0]:
            return f"ended before its signal: {said[-2000:]}"
    sent_s = time.monotonic()
    terminal = ENDS[end][0](pid, terminal)
    code, left = None, {pid: ""}
    while left and time.monotonic() < sent_s + limit_s:
        said += read_some(terminal)
        if code is None and (found := os.waitpid(pid, os.WNOHANG))[0]:
            code = os.waitstatus_to_exitcode(found[1])
        left = descendants()
    said += last_words(list(left), terminal)
    if terminal >= 0:
        os.close(terminal)
    if code is None:
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    partial = [path.name for path in out.rglob("*partial")]
    expected = BY_SIGNAL[ENDS[end][1]]
    wrong = [f"left: {', '.join(left.values())}"] * bool(left)
    wrong += [f"exit code {code}, not {expected}"] * (code != expected)
    wrong += [f"half-written: {partial}"] * (bool(partial) and end != "kill -9")
    # Python's thread that hands a worker's tensors over may speak when its partner is gone. The
    # worker may be killed before it has named a file.
    others = []
    for text in said.split("Traceback")[1:]:
        if "resource_sharer.py" not in text and 'File "' in text:
            others.append(text)
    wrong += ["a traceback"] * bool(others)
    return "; ".join(wrong) + f": {said[-4000:]}" * bool(wrong)


def at_work(name: str, said: str, out: Path) -> bool:
    """Whether a command has done a part of its work, so that its processes are there."""
    if "train" in name:
        return (out / "last_checkpoint").exists()
    return re.search(r"\b[1-9]\d*(/\d+ |samples )", said) is not None  # of its progress


def main() -> None:
    """Try all commands with all ends, and print the table."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # nohup ignores it, and children inherit that
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, nargs=2, metavar=("MINICITY", "CONFIG"), required=True)
    parser.add_argument("--command", nargs="+", choices=COMMANDS, default=COMMANDS)
    parser.add_argument("--end", nargs="+", choices=ENDS, default=list(ENDS))
    parser.add_argument("--limit", type=float, default=10.0, help="seconds that an end may take")
    args = parser.parse_args()
    from fuzz.commands import Data

    ctypes.CDLL(None).prctl(36, 1)  # orphans become children of this process
    data = Data(*args.data, samples=3000)
    print("| command |", " | ".join(args.end), "|\n|", "--- |" * (len(args.end) + 1))
    problems = []
    for name in args.command:
        row = []
        for end in args.end:
            begun_s = time.monotonic()
            problem = case(name, end, data, args.limit)
            row.append("something" if problem else "nothing")
            problems += [f"{name}, {end}: {problem}"] * bool(problem)
            print(name, end, problem[:300], f"{time.monotonic() - begun_s:.0f} s", file=sys.stderr)
            while True:  # reap the orphans
                try:
                    os.waitpid(-1, 0)
                except ChildProcessError:
                    break
        print(f"| {name} |", " | ".join(row), "|", flush=True)
    shutil.rmtree(data.folder)
    sys.exit("\n".join(problems) or 0)


if __name__ == "__main__":
    main()
