"""Read damaged files, case by case in child processes, and count how each reader ends.

``PYTHONPATH=tests:tests/map_data python -m fuzz --cases 5000`` prints the table of
results/tests.md; ``--reader NAME ...`` takes the readers whose names begin so.
"""

import argparse
import multiprocessing
import os
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from multiprocessing.connection import Connection
from pathlib import Path
from random import Random

from fuzz.readers import Files, Reader

OUTCOMES = (
    "clear", "right", "other value", "vague", "traceback", "crash", "hang", "silent", "outside",
    "code",
)  # fmt: skip
BAD = OUTCOMES[4:]
LIMIT_S = 120.0  # for one case


def run_cases(
    make: Callable[[], Reader], name: str, numbers: range, seed: int, pipe: Connection
) -> None:
    """Run cases of one reader and send how each ends."""
    with open(os.devnull, "w") as nothing, redirect_stdout(nothing), redirect_stderr(nothing):
        reader = make()
        sys.addaudithook(reader.watch)
        for number in numbers:
            pipe.send(reader.outcome(Random(f"{seed} {name} {number}")))


def run_reader(
    make: Callable[[], Reader], name: str, cases: int, seed: int
) -> list[tuple[str, str]]:
    """Return how each of a reader's cases ends; a child that dies or hangs is replaced."""
    fork = multiprocessing.get_context("fork")  # no import anew for each
    ends: list[tuple[str, str]] = []
    while len(ends) < cases:
        pipe, theirs = fork.Pipe(duplex=False)
        numbers = range(len(ends), cases)
        child = fork.Process(target=run_cases, args=(make, name, numbers, seed, theirs))
        child.start()
        theirs.close()
        try:
            while len(ends) < cases:
                ends.append(pipe.recv() if pipe.poll(LIMIT_S) else ("hang", ""))
                if ends[-1][0] == "hang":
                    break
        except EOFError:
            child.join()
            ends.append(("crash", f"exit code {child.exitcode}"))
        child.kill()
        child.join()
    return ends


def make_data(folder: Path) -> tuple[Path, Path]:
    """Make a tiny MiniCity and its annotation files."""
    from mapdata.nuscenes.convert import NuScenesOptions, convert_nuscenes
    from minicity.generate import generate

    root = folder / "root"
    generate(root=root, scenes=2, seed=0, image_size=(64, 36), samples_per_scene=2,
             sweeps_per_sample=1, val_scenes=1, workers=1)  # fmt: skip
    convert_nuscenes(NuScenesOptions(root, "v1.0-trainval", dataset="minicity"))
    return root, root / "gsmap_minicity_train.arrow"


def main() -> None:
    """Run the readers and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=5000, help="in all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--reader", nargs="+", default=[""], help="how the readers' names begin")
    parser.add_argument("--data", type=Path, nargs=2, help="a MiniCity and its annotation file")
    args = parser.parse_args()
    total: Counter[str] = Counter()
    with tempfile.TemporaryDirectory(prefix="gsmap-fuzz-") as folder:
        root, annotations = args.data or make_data(Path(folder))
        (work := Path(folder, "work")).mkdir()
        readers = Files(work, root, annotations).readers()
        chosen = {n: make for n, make in readers.items() if n.startswith(tuple(args.reader))}
        print("| reader |", " | ".join(OUTCOMES), "|\n|", "--- |" * (len(OUTCOMES) + 1))
        for name, make in chosen.items():
            ends = run_reader(make, name, -(-args.cases // len(chosen)), args.seed)
            counts = Counter(outcome for outcome, _ in ends)
            total += counts
            print(f"| {name} |", " | ".join(str(counts[o]) for o in OUTCOMES), "|", flush=True)
            for outcome in ("vague", *BAD):
                texts = {" ".join(text.split())[:250] for o, text in ends if o == outcome}
                for text in sorted(texts)[:5]:
                    print(f"    {name}: {outcome}: {text}", file=sys.stderr, flush=True)
        print(f"| all {total.total()} |", " | ".join(str(total[o]) for o in OUTCOMES), "|")
    sys.exit(any(total[outcome] for outcome in BAD))


if __name__ == "__main__":
    main()
