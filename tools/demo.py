#!/usr/bin/env python
"""Test a trained GSMap on MiniCity, then train one of your own (``make demo``).

First the model that ships is tested on validation towns, and its predictions are drawn. Then a
GSMap is trained on other towns, starting from the MapTR that ships (with ``--from-scratch`` another
one from nothing), and compared with it. The next run skips finished steps, and an interrupted
training continues.
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
from functools import partial
from pathlib import Path

from gsmap.datasets.annotations.record import CLASSES
from gsmap.utils.cli import CommandParser, run_command
from gsmap.utils.errors import WorkError
from gsmap.utils.files import write_text
from gsmap.utils.parallel import die_with_parent
from gsmap.utils.shipped import shipped
from gsmap.utils.words import markdown_table

MODELS = {"GSMap": "gsmap_r18_minicity", "MapTR": "maptr_r18_minicity"}  # that ship
NEXT = """
To go on in this environment:
    source {activate}
    gsmap --help
    gsmap test gsmap_r18_minicity --data-root {root}"""


@dataclass(frozen=True)
class Budget:
    """How much of everything a run makes.

    Attributes:
        train_scenes: Scenes of MiniCity to train on.
        val_scenes: Scenes to test on, in other towns.
        samples: Key frames per scene.
        tuning_epochs: Epochs of a training that starts from the MapTR that ships.
        epochs: Epochs of a training from scratch.
        image_size: Size of the images in pixels.
    """

    train_scenes: int
    val_scenes: int
    samples: int
    tuning_epochs: int
    epochs: int
    image_size: str = "400x225"


BUDGETS = {
    "tiny": Budget(4, 1, samples=2, tuning_epochs=1, epochs=1, image_size="200x112"),
    "demo": Budget(120, 30, samples=5, tuning_epochs=4, epochs=11),
    "long": Budget(320, 80, samples=5, tuning_epochs=4, epochs=16),
}


@dataclass(frozen=True)
class Training:
    """A model that the demo trains.

    Attributes:
        model: Its name in ``MODELS``.
        start: What its row in the table says of its start.
        work: Folder of its checkpoints; those of its tests begin with the same name.
        epochs: How long it trains.
        options: What differs from its config.
    """

    model: str
    start: str
    work: Path
    epochs: int
    options: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """Name of its row in the table."""
        return f"{self.model} {self.start}"

    def tested(self, how: str) -> Path:
        """Return the folder of one of its tests."""
        return self.work.with_name(f"{self.work.name}_{how}")


def trainings(
    names: Iterable[str], from_scratch: bool, folder: Path, budget: Budget
) -> list[Training]:
    """Return what is trained, in order."""
    found = []
    for name in names:
        work = folder / f"{name.lower()}_tuned"
        options = (f"load_from={MODELS['MapTR']}", "optim_wrapper.optimizer.lr=3e-4")
        found.append(Training(name, "trained on from MapTR", work, budget.tuning_epochs, options))
        if from_scratch:
            found.append(Training(name, "from scratch", folder / name.lower(), budget.epochs))
    return found


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
            command,
            cwd=shipped(),
            env=environment,
            check=False,
            preexec_fn=partial(die_with_parent, os.getpid()),
        ).returncode
        missing = [str(product) for product in self.products if not product.exists()]
        if status or missing:
            reason = f"made no {', '.join(missing)}" if not status else f"ended with {status}"
            raise WorkError(f"{position} {self.title} {reason}; run the command above to see why.")
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


def test_step(title: str, model: list[str], work: Path, root: Path, *extra: str) -> Step:
    """Return what tests a model on the towns of ``root`` into ``work/metrics.json``."""
    metrics = work / "metrics.json"
    command = ["tools/test.py", *model, "--work-dir", str(work), "--metrics-out", str(metrics)]
    return Step(title, [*command, *extra, "--data-root", str(root)], [metrics])


def drawing(work: Path) -> list[str]:
    """Return the options that draw every tenth sample and write what was found."""
    pictures = ["--show-dir", str(work / "pictures"), "--show-interval", "10"]
    return [*pictures, "--out", str(work / "results.json")]


def shipped_steps(name: str, folder: Path, budget: Budget) -> Iterable[Step]:
    """Yield what tests and draws a model that ships, and its report page."""
    work, root = folder / f"shipped_{name.lower()}", data_root(folder, budget, "val")
    title = f"test and draw the {name} that ships"
    yield test_step(title, [MODELS[name]], work, root, *drawing(work))
    truth, page = str(annotations(folder, budget, "val")), work / "report.html"
    yield Step(
        f"write the report page of the {name} that ships",
        ["tools/report.py", str(work / "results.json"), "--ann", truth, "--out", str(page)],
        [page],
    )


def training_steps(training: Training, folder: Path, budget: Budget) -> Iterable[Step]:
    """Yield what trains, tests and draws a model."""
    config, work, title = MODELS[training.model], training.work, training.title
    checkpoint = work / f"epoch_{training.epochs}.pth"
    train, val = (data_root(folder, budget, split) for split in ("train", "val"))
    options = [
        f"train_dataloader.dataset.data_root={train}",
        f"train_cfg.max_epochs={training.epochs}",
        f"train_cfg.val_interval={max(1, training.epochs // 4)}",
        "randomness.seed=0",
        *training.options,
    ]
    command = ["tools/dist_train.sh", config, str(processes()), "--work-dir", str(work), "--resume"]
    yield Step(
        f"train {title}",
        [*command, "--data-root", str(val), "--cfg-options", *options],
        [checkpoint],
    )
    curves = work / "curves.png"
    yield Step(
        f"draw losses and validations of {title}",
        ["tools/analyze_run.py", str(work), "--out", str(curves)],
        [curves],
    )
    model, tested = [config, str(checkpoint)], training.tested("test")
    yield test_step(f"test and draw {title}", model, tested, val, *drawing(tested))
    title, shuffled = f"test {title} on images of other samples", training.tested("shuffled")
    yield test_step(title, model, shuffled, val, "--shuffle-images", "0")


def table(folder: Path, shipped: Iterable[str], trained: Iterable[Training]) -> str:
    """Return the figures of all models as a Markdown table."""
    rows = {"same map everywhere (prior)": folder / "prior.json"}
    for name in shipped:
        rows[f"{name} that ships"] = folder / f"shipped_{name.lower()}/metrics.json"
    for training in trained:
        rows[training.title] = training.tested("test") / "metrics.json"
        others = f"{training.title}, images of other samples"
        rows[others] = training.tested("shuffled") / "metrics.json"
    keys = [[f"{metric}/{c}/AP" for c in CLASSES] for metric in ("chamfer", "raster")]
    keys = [*keys[0], "chamfer/mAP", *keys[1], "raster/mAP"]
    head = ["model", *(key.replace("/AP", "").replace("/", " ") for key in keys)]
    lines = []
    for name, path in rows.items():
        figures = json.loads(path.read_text())
        cells = [f"{100 * figures[key]:.1f}" if key in figures else "" for key in keys]
        lines.append([name, *cells])
    return markdown_table(head, lines)


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
    parser.add_argument(
        "--from-scratch", action="store_true", help="also train each model from nothing"
    )
    args = parser.parse_args()
    budget, folder = BUDGETS[args.budget], Path(args.dir).resolve() / args.budget
    started = time.monotonic()
    runs = trainings(args.models, args.from_scratch, folder, budget)
    shipped = list(data_steps(folder, budget, "val"))
    for name in args.models:
        shipped += shipped_steps(name, folder, budget)
    trained = [*data_steps(folder, budget, "train"), prior_step(folder, budget)]
    if "MapTR" not in args.models:  # the start of every training
        trained += shipped_steps("MapTR", folder, budget)
    for training in runs:
        trained += training_steps(training, folder, budget)
    for number, step in enumerate([*shipped, *trained], 1):
        step.run(folder, f"[{number}/{len(shipped) + len(trained)}]")
        if number == len(shipped):
            minutes = (time.monotonic() - started) / 60
            for name in args.models:
                work = folder / f"shipped_{name.lower()}"
                print(f"\n{minutes:.1f} min: what the {name} that ships sees:")
                print(f"{first_picture(work)}\n{work / 'report.html'}\n", flush=True)
    summary = table(folder, dict.fromkeys([*args.models, "MapTR"]), runs)
    print(f"\nAP in percent on MiniCity's validation towns\n\n{summary}\n")
    write_text(folder / "summary.md", summary + "\n")
    for training in runs:
        print(f"{training.title}: {first_picture(training.tested('test'))}")
        print(f"its losses and validations: {training.work / 'curves.png'}")
    print(f"{(time.monotonic() - started) / 60:.1f} minutes. Figures: {folder / 'summary.md'}")
    root = data_root(folder, budget, "val")
    print(NEXT.format(activate=Path(sys.prefix, "bin/activate"), root=root))


if __name__ == "__main__":
    run_command(main)
