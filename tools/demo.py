#!/usr/bin/env python
"""GSMap from nothing to pictures on MiniCity: generate, convert, train, test, draw (``make demo``).

What is done is skipped on the next run; an interrupted training goes on where it stopped.
"""

import hashlib
import json
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import torch

from gsmap.utils.cli import CommandParser, run_command
from gsmap.utils.files import write_text

REPO = Path(__file__).resolve().parents[1]
CONFIGS = {
    "GSMap": "projects/GSMap/configs/gsmap_maptr_r18_minicity.py",
    "MapTR": "configs/maptr/maptr_r18_minicity.py",
}
CLASSES = ("divider", "ped_crossing", "boundary")


@dataclass(frozen=True)
class Budget:
    """How much of everything a run makes.

    Attributes:
        scenes: Scenes of MiniCity; a fifth of them is for validation.
        samples: Key frames per scene.
        epochs: Training epochs.
        image_size: Size of the images in pixels.
    """

    scenes: int
    samples: int
    epochs: int
    image_size: str = "400x225"


BUDGETS = {
    "tiny": Budget(scenes=5, samples=2, epochs=1, image_size="200x112"),
    "demo": Budget(scenes=150, samples=5, epochs=11),
    "long": Budget(scenes=400, samples=5, epochs=16),
}


@dataclass(frozen=True)
class Step:
    """One command of the demo.

    Attributes:
        title: What it does.
        command: The script and its arguments.
        products: What it must have made.
    """

    title: str
    command: list[str]
    products: list[Path]

    def stamp(self, folder: Path) -> Path:
        """Return the file that says that this very command has succeeded."""
        digest = hashlib.sha256(shlex.join(self.command).encode()).hexdigest()[:12]
        return folder / ".done" / f"{self.title.replace(' ', '-')}-{digest}"

    def run(self, folder: Path, position: str) -> None:
        """Run the command unless it is done; stop the demo if it fails."""
        stamp = self.stamp(folder)
        if stamp.exists() and all(product.exists() for product in self.products):
            print(f"{position} {self.title}: done before, skipped", flush=True)
            return
        shell = self.command[0].endswith(".sh")
        command = self.command if shell else [sys.executable, *self.command]
        print(f"{position} {self.title}: {shlex.join(command)}", flush=True)
        started = time.monotonic()
        environment = {**os.environ, "PYTHON": sys.executable}
        status = subprocess.run(command, cwd=REPO, env=environment, check=False).returncode
        missing = [str(product) for product in self.products if not product.exists()]
        if status or missing:
            reason = f"made no {', '.join(missing)}" if not status else f"ended with {status}"
            raise RuntimeError(
                f"{position} {self.title} {reason}; run the command above to see why."
            )
        write_text(stamp, f"{time.monotonic() - started:.0f} s\n")
        print(f"{position} {self.title}: {time.monotonic() - started:.0f} s", flush=True)


def processes() -> int:
    """Return how many processes train together: one per GPU, or per core without a GPU.

    On a CPU a process of one thread per core uses the cores better than threads of one process.
    """
    return torch.cuda.device_count() or len(os.sched_getaffinity(0))


def data_steps(folder: Path, budget: Budget) -> Iterable[Step]:
    """Yield what makes the data set and scores a model that does not look at it."""
    root = folder / f"minicity-{budget.scenes}x{budget.samples}"
    splits = [root / f"gsmap_minicity_{split}.arrow" for split in ("train", "val")]
    command = f"--scenes {budget.scenes} --samples-per-scene {budget.samples} --seed 0"
    yield Step(
        "generate MiniCity",
        [
            "tools/create_data.py",
            "minicity",
            "--root",
            str(root),
            *command.split(),
            "--image-size",
            budget.image_size,
        ],
        [root / "minicity.json"],
    )
    yield Step(
        "convert it",
        ["tools/create_data.py", "nuscenes", "--root", str(root), "--dataset", "minicity"],
        splits,
    )
    metrics = folder / "prior.json"
    yield Step(
        "score the prior",
        ["tools/evaluate.py", str(splits[1]), "--prior", str(splits[0]), "--out", str(metrics)],
        [metrics],
    )


def model_steps(name: str, folder: Path, budget: Budget) -> Iterable[Step]:
    """Yield what trains, tests and draws a model."""
    config, work = CONFIGS[name], folder / name.lower()
    root = folder / f"minicity-{budget.scenes}x{budget.samples}"
    options = [
        "--cfg-options",
        *(f"{part}_dataloader.dataset.data_root={root}/" for part in ("train", "val", "test")),
        f"train_cfg.max_epochs={budget.epochs}",
        f"train_cfg.val_interval={budget.epochs}",
        f"param_scheduler.1.T_max={budget.epochs}",
    ]
    checkpoint = work / f"epoch_{budget.epochs}.pth"
    training = ["--work-dir", str(work), "--resume", *options, "randomness.seed=0"]
    yield Step(
        f"train {name}",
        ["tools/dist_train.sh", config, str(processes()), *training],
        [checkpoint],
    )
    test = ["tools/test.py", config, str(checkpoint), "--eval", "chamfer", "raster"]
    metrics, pictures = work / "metrics.json", work / "pictures"
    drawing = ["--show-dir", str(pictures), "--show-interval", "10"]
    drawing += ["--out", str(work / "results.json"), "--metrics-out", str(metrics)]
    yield Step(
        f"test and draw {name}",
        [*test, "--work-dir", str(work / "test"), *drawing, *options],
        [metrics, pictures],
    )
    shuffled = work / "metrics_shuffled.json"
    shuffling = ["--shuffle-images", "0", "--metrics-out", str(shuffled)]
    yield Step(
        f"test {name} on images of other samples",
        [*test, "--work-dir", str(work / "shuffled"), *shuffling, *options],
        [shuffled],
    )


def table(folder: Path, models: Iterable[str]) -> str:
    """Return the figures of all models as a Markdown table."""
    rows = {"same map everywhere (prior)": folder / "prior.json"}
    for name in models:
        rows[name] = folder / name.lower() / "metrics.json"
        rows[f"{name}, images of other samples"] = folder / name.lower() / "metrics_shuffled.json"
    head = ["model", *(f"{metric} {c}" for metric in ("chamfer", "raster") for c in CLASSES)]
    head[4:4], head[8:8] = ["**chamfer mAP**"], ["**raster mAP**"]
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    for name, path in rows.items():
        figures = json.loads(path.read_text())
        keys = [[f"{metric}/{c}/AP" for c in CLASSES] for metric in ("chamfer", "raster")]
        keys = [*keys[0], "chamfer/mAP", *keys[1], "raster/mAP"]
        cells = [f"{100 * figures[key]:.1f}" if key in figures else "" for key in keys]
        lines.append("| " + " | ".join([name, *cells]) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = CommandParser(description=__doc__)
    parser.add_argument("--dir", default="demo", help="where everything goes")
    parser.add_argument("--budget", choices=BUDGETS, default="demo", help="how long to train")
    parser.add_argument(
        "--models", nargs="+", choices=CONFIGS, default=["GSMap"], help="what to train, in order"
    )
    args = parser.parse_args()
    budget, folder = BUDGETS[args.budget], Path(args.dir).resolve() / args.budget
    started = time.monotonic()
    steps = list(data_steps(folder, budget))
    for name in args.models:
        steps += model_steps(name, folder, budget)
    for number, step in enumerate(steps, 1):
        step.run(folder, f"[{number}/{len(steps)}]")
    summary = table(folder, args.models)
    write_text(folder / "summary.md", summary + "\n")
    print(f"\nAP in percent on MiniCity's validation towns, {budget.epochs} epochs\n\n{summary}\n")
    for name in args.models:
        pictures = sorted((folder / name.lower() / "pictures").iterdir())
        print(f"{name}: {len(pictures)} pictures, e.g. {pictures[0]}")
    print(f"{(time.monotonic() - started) / 60:.1f} minutes. Figures: {folder / 'summary.md'}")


if __name__ == "__main__":
    run_command(main)
