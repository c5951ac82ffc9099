#!/usr/bin/env python
"""Test a trained GSMap on MiniCity, then train one from scratch (``make demo``).

First the model that ships is tested on validation towns, and its predictions are drawn. Then a
model is trained from scratch and compared with it. The next run skips finished steps, and an
interrupted training continues.
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

from gsmap.utils.cli import CommandParser, run_command
from gsmap.utils.files import write_text
from gsmap.utils.parallel import die_with_parent
from gsmap.utils.shipped import shipped

MODELS = {"GSMap": "gsmap_r18_minicity", "MapTR": "maptr_r18_minicity"}  # that ship
NEXT = """
To go on in this environment:
    source {activate}
    gsmap --help
    gsmap test gsmap_r18_minicity --data-root {root}"""
CLASSES = ("divider", "ped_crossing", "boundary")


@dataclass(frozen=True)
class Budget:
    """How much of everything a run makes.

    Attributes:
        train_scenes: Scenes of MiniCity to train on.
        val_scenes: Scenes to test on, in other towns.
        samples: Key frames per scene.
        epochs: Training epochs.
        image_size: Size of the images in pixels.
    """

    train_scenes: int
    val_scenes: int
    samples: int
    epochs: int
    image_size: str = "400x225"


BUDGETS = {
    "tiny": Budget(train_scenes=4, val_scenes=1, samples=2, epochs=1, image_size="200x112"),
    "demo": Budget(train_scenes=120, val_scenes=30, samples=5, epochs=11),
    "long": Budget(train_scenes=320, val_scenes=80, samples=5, epochs=16),
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
        status = subprocess.run(
            command, cwd=shipped(), env=environment, check=False, preexec_fn=die_with_parent
        ).returncode
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
    import torch

    return torch.cuda.device_count() or len(os.sched_getaffinity(0))


def data_root(folder: Path, budget: Budget, split: str) -> Path:
    """Return where a split's towns are."""
    scenes = budget.val_scenes if split == "val" else budget.train_scenes
    return folder / f"minicity-{split}-{scenes}x{budget.samples}"


def annotations(folder: Path, budget: Budget, split: str) -> Path:
    """Return a split's annotation file."""
    return data_root(folder, budget, split) / f"gsmap_minicity_{split}.arrow"


def data_steps(folder: Path, budget: Budget, split: str) -> Iterable[Step]:
    """Yield what makes the towns of one split.

    A data set has at least one scene of either split; the other one's is not used.
    """
    root = data_root(folder, budget, split)
    scenes = (budget.val_scenes if split == "val" else budget.train_scenes) + 1
    size = f"--scenes {scenes} --val-scenes {budget.val_scenes if split == 'val' else 1}"
    size += f" --samples-per-scene {budget.samples} --seed 0 --image-size {budget.image_size}"
    yield Step(
        f"generate the towns of {split}",
        ["tools/create_data.py", "minicity", "--root", str(root), *size.split()],
        [root / "minicity.json"],
    )
    yield Step(
        f"convert the towns of {split}",
        ["tools/create_data.py", "nuscenes", "--root", str(root), "--dataset", "minicity"],
        [annotations(folder, budget, split)],
    )


def prior_step(folder: Path, budget: Budget) -> Step:
    """Return what scores a map that is the same everywhere."""
    truth, train = (str(annotations(folder, budget, split)) for split in ("val", "train"))
    metrics = folder / "prior.json"
    return Step(
        "score the best fixed map (prior)",
        ["tools/evaluate.py", truth, "--prior", train, "--out", str(metrics)],
        [metrics],
    )


def options_of(folder: Path, budget: Budget) -> list[str]:
    """Return the overrides that all commands of models share."""
    train, val = (str(data_root(folder, budget, split)) for split in ("train", "val"))
    return [
        "--data-root",
        val,
        "--cfg-options",
        f"train_dataloader.dataset.data_root={train}",
        f"train_cfg.max_epochs={budget.epochs}",
        f"train_cfg.val_interval={max(1, budget.epochs // 4)}",
        "randomness.seed=0",
    ]


def test_step(title: str, model: list[str], work: Path, *extra: str, common: list[str]) -> Step:
    """Return what tests a model into ``work/metrics.json``."""
    metrics = work / "metrics.json"
    command = ["tools/test.py", *model, "--work-dir", str(work), "--metrics-out", str(metrics)]
    return Step(title, [*command, *extra, *common], [metrics])


def drawing(work: Path) -> list[str]:
    """Return the options that draw every tenth sample and write what was found."""
    pictures = ["--show-dir", str(work / "pictures"), "--show-interval", "10"]
    return [*pictures, "--out", str(work / "results.json")]


def shipped_steps(name: str, folder: Path, budget: Budget) -> Iterable[Step]:
    """Yield what tests and draws a model that ships, and its report page."""
    work, common = folder / f"shipped_{name.lower()}", options_of(folder, budget)
    title = f"test and draw the {name} that ships"
    yield test_step(title, [MODELS[name]], work, *drawing(work), common=common)
    truth, page = str(annotations(folder, budget, "val")), work / "report.html"
    yield Step(
        f"write the report page of the {name} that ships",
        ["tools/report.py", str(work / "results.json"), "--ann", truth, "--out", str(page)],
        [page],
    )


def model_steps(name: str, folder: Path, budget: Budget) -> Iterable[Step]:
    """Yield what trains, tests and draws a model."""
    config, work, common = MODELS[name], folder / name.lower(), options_of(folder, budget)
    checkpoint = work / f"epoch_{budget.epochs}.pth"
    training = ["--work-dir", str(work), "--resume", *common]
    yield Step(
        f"train {name}",
        ["tools/dist_train.sh", config, str(processes()), *training],
        [checkpoint],
    )
    curves = work / "curves.png"
    yield Step(
        f"draw losses and validations of {name}",
        ["tools/analyze_run.py", str(work), "--out", str(curves)],
        [curves],
    )
    model, tested = [config, str(checkpoint)], folder / f"{name.lower()}_test"
    yield test_step(f"test and draw {name}", model, tested, *drawing(tested), common=common)
    shuffled, shuffling = folder / f"{name.lower()}_shuffled", ("--shuffle-images", "0")
    title = f"test {name} on images of other samples"
    yield test_step(title, model, shuffled, *shuffling, common=common)


def table(folder: Path, models: Iterable[str]) -> str:
    """Return the figures of all models as a Markdown table."""
    rows = {"same map everywhere (prior)": folder / "prior.json"}
    for name in models:
        rows[f"{name} that ships"] = folder / f"shipped_{name.lower()}/metrics.json"
        rows[f"{name} from scratch"] = folder / f"{name.lower()}_test/metrics.json"
        shuffled = f"{name} from scratch, images of other samples"
        rows[shuffled] = folder / f"{name.lower()}_shuffled/metrics.json"
    keys = [[f"{metric}/{c}/AP" for c in CLASSES] for metric in ("chamfer", "raster")]
    keys = [*keys[0], "chamfer/mAP", *keys[1], "raster/mAP"]
    head = ["model", *(key.replace("/AP", "").replace("/", " ") for key in keys)]
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    for name, path in rows.items():
        figures = json.loads(path.read_text())
        cells = [f"{100 * figures[key]:.1f}" if key in figures else "" for key in keys]
        lines.append("| " + " | ".join([name, *cells]) + " |")
    return "\n".join(lines)


def first_picture(folder: Path) -> Path:
    """Return one of the pictures that a test drew."""
    return sorted((folder / "pictures").iterdir())[0]


def main() -> None:
    parser = CommandParser(description=__doc__)
    parser.add_argument("--dir", default="demo", help="folder of all outputs")
    parser.add_argument("--budget", choices=BUDGETS, default="demo", help="how long to train")
    parser.add_argument(
        "--models", nargs="+", choices=MODELS, default=["GSMap"], help="what to train, in order"
    )
    args = parser.parse_args()
    budget, folder = BUDGETS[args.budget], Path(args.dir).resolve() / args.budget
    started = time.monotonic()
    shipped = list(data_steps(folder, budget, "val"))
    for name in args.models:
        shipped += shipped_steps(name, folder, budget)
    trained = [*data_steps(folder, budget, "train"), prior_step(folder, budget)]
    for name in args.models:
        trained += model_steps(name, folder, budget)
    for number, step in enumerate([*shipped, *trained], 1):
        step.run(folder, f"[{number}/{len(shipped) + len(trained)}]")
        if number == len(shipped):
            minutes = (time.monotonic() - started) / 60
            for name in args.models:
                work = folder / f"shipped_{name.lower()}"
                print(f"\n{minutes:.1f} min: what the {name} that ships sees:")
                print(f"{first_picture(work)}\n{work / 'report.html'}\n", flush=True)
    summary = table(folder, args.models)
    print(f"\nAP in percent on MiniCity's validation towns, {budget.epochs} epochs\n\n{summary}\n")
    write_text(folder / "summary.md", summary + "\n")
    for name in args.models:
        print(f"{name} from scratch: {first_picture(folder / f'{name.lower()}_test')}")
        print(f"its losses and validations: {folder / name.lower() / 'curves.png'}")
    print(f"{(time.monotonic() - started) / 60:.1f} minutes. Figures: {folder / 'summary.md'}")
    root = data_root(folder, budget, "val")
    print(NEXT.format(activate=Path(sys.prefix, "bin/activate"), root=root))


if __name__ == "__main__":
    run_command(main)
