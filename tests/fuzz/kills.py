"""Commands that are killed with ``kill -9`` at moments spread over their work, then run again.

``PYTHONPATH=.:tests python -m fuzz.kills --kills 20 --data MINICITY CONFIG`` prints a table. What
the second run leaves must be what a run without a kill leaves.
"""

import argparse
import os
import shutil
import signal
import sys
import time
from pathlib import Path
from typing import Any

import torch

from fuzz.commands import Data, Work, start
from gsmap.checkpoints.safe_globals import mmengine_globals
from gsmap.utils.files import SUFFIX

NAMES = {
    "train": "training",
    "create_data": "conversion",
    "infer": "inference",
    "build_map": "drive maps",
}
LIMIT_S = 600.0


def run(work: Work, kill_after_s: float = LIMIT_S) -> tuple[int, str]:
    """Run a command, and kill it if it has not ended by then; exit code, and what it said."""
    pid, terminal = start(work)
    os.set_blocking(terminal, False)
    said, until = b"", time.monotonic() + kill_after_s
    status = 0
    while not (found := os.waitpid(pid, os.WNOHANG))[0] and time.monotonic() < until:
        said += _read(terminal)
        time.sleep(0.01)
    if not found[0]:
        os.kill(pid, signal.SIGKILL)
        found = os.waitpid(pid, 0)
    status = os.waitstatus_to_exitcode(found[1])
    # Its workers end soon after it, and until then hold its files. The terminal ends with the last.
    os.set_blocking(terminal, True)
    while more := _read(terminal):
        said += more
    os.close(terminal)
    return status, said.decode(errors="replace")


def _read(terminal: int) -> bytes:
    try:
        return os.read(terminal, 100_000)
    except OSError:  # nothing to read, or its other end is closed
        return b""


def content(folder: Path) -> dict[str, Any]:
    """Return what a run has left, by file; of checkpoints the tensors alone."""
    files = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if not path.is_file() or name.startswith(("20", ".", "last_checkpoint")):
            continue
        if path.suffix == ".py":  # a run's config says what it went on from
            continue
        if path.suffix == ".pth":
            with torch.serialization.safe_globals(mmengine_globals()):
                state = torch.load(path, weights_only=True)
            files[name] = [state["state_dict"], state.get("optimizer")]
        else:
            files[name] = path.read_bytes()
    return files


def same(left: Any, right: Any) -> bool:
    """Whether two contents are equal, bit by bit."""
    if isinstance(left, torch.Tensor):
        return torch.equal(left, right)
    if isinstance(left, dict):
        return left.keys() == right.keys() and all(same(left[k], right[k]) for k in left)
    if isinstance(left, list):
        return len(left) == len(right) and all(map(same, left, right))
    return bool(left == right)


def case(data: Data, name: str, kill_after_s: float, whole: dict[str, Any]) -> tuple[str, bool]:
    """Kill a command once, run it again, and say what is wrong then; and whether it was killed."""
    out = data.empty_folder()
    code, said = run(data.commands(out)[name], kill_after_s)
    killed = code == -signal.SIGKILL
    if not killed and code:
        return f"ended with {code}: {said[-500:]}", killed
    code, said = run(data.commands(out)[name])
    if code:
        return f"ended with {code} after the kill: {said[-500:]}", killed
    found = content(out)
    left = [path.name for path in out.rglob(f"*{SUFFIX}")]
    wrong = sorted(key for key in {*whole, *found} if not same(whole.get(key), found.get(key)))
    return f"other content: {', '.join(wrong)}" * bool(wrong) + f"left: {left}" * bool(left), killed


def main() -> None:
    """Kill all commands, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, nargs=2, metavar=("MINICITY", "CONFIG"), required=True)
    parser.add_argument("--kills", type=int, default=20, help="of each command")
    parser.add_argument("--command", nargs="+", choices=NAMES, default=list(NAMES))
    args = parser.parse_args()
    data, problems = Data(*args.data, samples=20), []
    print("| command | seconds without a kill | kills | the same afterwards |")
    print("| --- | --- | --- | --- |")
    for name in args.command:
        out = data.empty_folder()
        begun_s = time.monotonic()
        code, said = run(data.commands(out)[name])
        lasts_s = time.monotonic() - begun_s
        if code:
            sys.exit(f"{name} ended with {code}: {said[-2000:]}")
        whole = content(out)
        kills = right = 0
        while kills < args.kills:
            problem, killed = case(data, name, lasts_s * (kills + 0.5) / args.kills, whole)
            kills += killed or bool(problem)
            right += killed and not problem
            problems += [f"{name}, kill {kills}: {problem}"] * bool(problem)
            lasts_s *= 1.0 if killed else 0.9
        print(f"| {NAMES[name]} | {lasts_s:.1f} | {kills} | {right} |", flush=True)
    shutil.rmtree(data.folder)
    sys.exit("\n".join(problems) or 0)


if __name__ == "__main__":
    main()
