#!/usr/bin/env python
"""Test a trained GSMap on MiniCity, then train one of your own (``make demo``).

First the GSMap that ships with the project is tested on validation towns, and its predictions are
drawn. Then another GSMap is trained on other towns. It starts from the MapTR that ships; with
``--from-scratch``, a third one starts from random weights. A table compares all of them. When the
command is given again, it skips finished steps and continues an interrupted training.
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
from gsmap.utils.cli import CommandParser, EachOnce, run_command
from gsmap.utils.errors import WorkError
from gsmap.utils.files import write_text
from gsmap.utils.parallel import die_with_parent
from gsmap.utils.shipped import shipped_path
from gsmap.utils.words import markdown_table

MODELS = {"GSMap": "gsmap_r18_minicity", "MapTR": "maptr_r18_minicity"}
"""Names of the models that ship with the library, by the title of their method."""
# Text at the end. `activate` is a script of the Python environment, `root` the folder of the data.
NEXT = """
To go on in this environment:
    source {activate}
    gsmap --help
    gsmap test gsmap_r18_minicity --data-root {root}"""


@dataclass(frozen=True)
class Budget:
    """Size of the data and length of the trainings.

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
        model: Name of the model in ``MODELS``.
        start: Weights from which the training starts, in the words of the table.
        work: Folder of the checkpoints. The folders of the tests begin with its name.
        epochs: Number of epochs.
        options: Overrides of the config, each ``key=value``.
    """

    model: str
    start: str
    work: Path
    epochs: int
    options: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """Name of the row in the table."""
        return f"{self.model} {self.start}"

    def test_folder(self, name: str) -> Path:
        """Folder of one of the tests: ``test``, or ``shuffled`` with images of other samples."""
        return self.work.with_name(f"{self.work.name}_{name}")


def trainings(
    names: Iterable[str], from_scratch: bool, folder: Path, budget: Budget
) -> list[Training]:
    """Trainings in their order.

    Args:
        names: Names of the models in ``MODELS``.
        from_scratch: Whether to train each model from random weights as well.
        folder: Folder of all outputs.
        budget: Lengths of the trainings.
    """
    runs = []
    for name in names:
        work = folder / f"{name.lower()}_tuned"
        # The training starts from the weights of the MapTR that ships.
        options = (f"load_from={MODELS['MapTR']}", "optim_wrapper.optimizer.lr=3e-4")
        tuned = Training(
            name,
            start="trained on from MapTR",
            work=work,
            epochs=budget.tuning_epochs,
            options=options,
        )
        runs.append(tuned)
        if from_scratch:
            work = folder / name.lower()
            runs.append(Training(name, start="from scratch", work=work, epochs=budget.epochs))
    return runs


@dataclass(frozen=True)
class Step:
    """One command of the demo.

    Attributes:
        title: Action of the command, for the console.
        command: The script and its arguments.
        products: Files that exist when the command has succeeded.
    """

    title: str
    command: list[str]
    products: list[Path]

    def stamp(self, folder: Path) -> Path:
        """File that marks the success of this command with these arguments.

        Its name has a digest of the command, so a command with other arguments runs again.
        """
        digest = hashlib.sha256(shlex.join(self.command).encode()).hexdigest()[:12]
        return folder / ".done" / f"{self.title.replace(' ', '-')}-{digest}"

    def run(self, folder: Path, position: str) -> None:
        """Run the command, unless an earlier run has succeeded.

        Raises:
            WorkError: If the command fails, or one of its products is missing.
        """
        stamp = self.stamp(folder)
        if stamp.exists() and all(product.exists() for product in self.products):
            print(f"{position} {self.title}: done before, skipped", flush=True)
            return
        is_shell_script = self.command[0].endswith(".sh")
        command = self.command if is_shell_script else [sys.executable, *self.command]
        print(f"{position} {self.title}: {shlex.join(command)}", flush=True)
        start_s = time.monotonic()
        environment = {**os.environ, "PYTHON": sys.executable}  # read by the shell scripts
        status = subprocess.run(
            command,
            cwd=shipped_path(),  # root of the installed repository, for paths such as tools/test.py
            env=environment,
            check=False,
            # On Linux, the command is killed if the demo dies.
            preexec_fn=partial(die_with_parent, os.getpid()),
        ).returncode
        missing = [str(product) for product in self.products if not product.exists()]
        if status or missing:
            reason = f"ended with {status}" if status else f"made no {', '.join(missing)}"
            raise WorkError(f"{position} {self.title} {reason}; run the command above to see why.")
        duration_s = time.monotonic() - start_s
        write_text(stamp, f"{duration_s:.0f} s\n")
        print(f"{position} {self.title}: {duration_s:.0f} s", flush=True)


def process_count() -> int:
    """Number of processes that train together: one per GPU, or per core without a GPU.

    On a CPU, one process with one thread per core uses the cores better than one process with many
    threads.
    """
    import torch  # imported here: it loads slowly, and --help does not need it

    return torch.cuda.device_count() or len(os.sched_getaffinity(0))


def data_root(folder: Path, budget: Budget, split: str) -> Path:
    """Folder with the towns of a split.

    Args:
        folder: Folder of all outputs.
        budget: Numbers of scenes and samples.
        split: ``train`` or ``val``.
    """
    scenes = budget.val_scenes if split == "val" else budget.train_scenes
    return folder / f"minicity-{split}-{scenes}x{budget.samples}"


def annotations(folder: Path, budget: Budget, split: str) -> Path:
    """Annotation file of a split.

    Args:
        folder: Folder of all outputs.
        budget: Numbers of scenes and samples.
        split: ``train`` or ``val``.
    """
    return data_root(folder, budget, split) / f"gsmap_minicity_{split}.arrow"


def data_steps(folder: Path, budget: Budget, split: str) -> Iterable[Step]:
    """Yield the steps that generate and convert the towns of one split.

    A data set needs at least one scene of each split, so one unused scene of the other split is
    generated as well.

    Args:
        folder: Folder of all outputs.
        budget: Numbers of scenes and samples.
        split: ``train`` or ``val``.
    """
    root = data_root(folder, budget, split)
    if split == "val":
        val_scenes = budget.val_scenes
        scenes = budget.val_scenes + 1
    else:
        val_scenes = 1
        scenes = budget.train_scenes + 1
    generate = ["tools/create_data.py", "minicity", "--root", str(root)]
    generate += ["--scenes", str(scenes), "--val-scenes", str(val_scenes)]
    generate += ["--samples-per-scene", str(budget.samples), "--seed", "0"]
    generate += ["--image-size", budget.image_size]
    convert = ["tools/create_data.py", "nuscenes", "--root", str(root), "--dataset", "minicity"]
    yield Step(f"generate the towns of {split}", generate, [root / "minicity.json"])
    yield Step(f"convert the towns of {split}", convert, [annotations(folder, budget, split)])


def prior_step(folder: Path, budget: Budget) -> Step:
    """Step that scores the best fixed map, which is predicted for every sample.

    The map is fitted on the training data. Its score shows how much is possible without images.
    """
    truth = annotations(folder, budget, "val")
    train = annotations(folder, budget, "train")
    metrics = folder / "prior.json"
    command = ["tools/evaluate.py", str(truth), "--prior", str(train), "--out", str(metrics)]
    return Step("score the best fixed map (prior)", command, [metrics])


def test_step(title: str, model: list[str], work: Path, root: Path, options: list[str]) -> Step:
    """Step that tests a model and writes ``work/metrics.json``.

    Args:
        title: Action of the step, for the console.
        model: First arguments of ``tools/test.py``: the name of a model that ships, or config and
            checkpoint.
        work: Work folder of the test.
        root: Data root: folder with the towns.
        options: Further options of ``tools/test.py``.
    """
    metrics = work / "metrics.json"
    command = ["tools/test.py", *model, "--work-dir", str(work), "--metrics-out", str(metrics)]
    command += [*options, "--data-root", str(root)]
    return Step(title, command, [metrics])


def drawing_options(work: Path) -> list[str]:
    """Options that draw every tenth sample and write the predictions."""
    pictures = ["--show-dir", str(work / "pictures"), "--show-interval", "10"]
    return [*pictures, "--out", str(work / "results.json")]


def shipped_steps(name: str, folder: Path, budget: Budget) -> Iterable[Step]:
    """Yield the steps that test and draw a model that ships, and write its report page.

    Args:
        name: Name of the model in ``MODELS``.
        folder: Folder of all outputs.
        budget: Numbers of scenes and samples.
    """
    work = folder / f"shipped_{name.lower()}"
    root = data_root(folder, budget, "val")
    title = f"test and draw the {name} that ships"
    yield test_step(title, [MODELS[name]], work, root, options=drawing_options(work))
    truth = annotations(folder, budget, "val")
    page = work / "report.html"
    command = ["tools/report.py", str(work / "results.json")]
    command += ["--ann", str(truth), "--out", str(page)]
    yield Step(f"write the report page of the {name} that ships", command, [page])


def training_steps(training: Training, folder: Path, budget: Budget) -> Iterable[Step]:
    """Yield the steps that train, test and draw a model.

    Args:
        training: The training.
        folder: Folder of all outputs.
        budget: Numbers of scenes and samples.
    """
    config = MODELS[training.model]
    work = training.work
    title = training.title
    checkpoint = work / f"epoch_{training.epochs}.pth"
    train = data_root(folder, budget, "train")
    val = data_root(folder, budget, "val")
    # ``--data-root`` below sets the folder of all data sets. The first of these options overrides
    # it for the training data.
    options = [
        f"train_dataloader.dataset.data_root={train}",
        f"train_cfg.max_epochs={training.epochs}",
        f"train_cfg.val_interval={max(1, training.epochs // 4)}",
        "randomness.seed=0",
        *training.options,
    ]
    command = ["tools/dist_train.sh", config, str(process_count())]
    command += ["--work-dir", str(work), "--resume"]
    command += ["--data-root", str(val), "--cfg-options", *options]
    yield Step(f"train {title}", command, [checkpoint])
    curves = work / "curves.png"
    command = ["tools/analyze_run.py", str(work), "--out", str(curves)]
    yield Step(f"draw losses and validations of {title}", command, [curves])
    model = [config, str(checkpoint)]
    test = training.test_folder("test")
    yield test_step(f"test and draw {title}", model, test, val, options=drawing_options(test))
    # The score with wrong images shows how much the model depends on its images.
    yield test_step(
        f"test {title} on images of other samples",
        model,
        training.test_folder("shuffled"),
        val,
        options=["--shuffle-images", "0"],
    )


def table(folder: Path, shipped: Iterable[str], trained: Iterable[Training]) -> str:
    """Figures of all models as a Markdown table.

    Args:
        folder: Folder of all outputs.
        shipped: Names of the models that ship.
        trained: The trainings of the demo.
    """
    # File of the metrics of each row, by the name of the row.
    rows = {"same map everywhere (prior)": folder / "prior.json"}
    for name in shipped:
        rows[f"{name} that ships"] = folder / f"shipped_{name.lower()}/metrics.json"
    for training in trained:
        rows[training.title] = training.test_folder("test") / "metrics.json"
        others = f"{training.title}, images of other samples"
        rows[others] = training.test_folder("shuffled") / "metrics.json"
    keys = []
    head = ["model"]  # headings, one for each key behind the first column
    for metric in ("chamfer", "raster"):
        for name in CLASSES:
            keys.append(f"{metric}/{name}/AP")
            head.append(f"{metric} {name}")
        keys.append(f"{metric}/mAP")
        head.append(f"{metric} mAP")
    lines = []  # cells of each row
    for name, path in rows.items():
        figures = json.loads(path.read_text())
        # A cell is empty if the metrics lack the figure.
        cells = [f"{100 * figures[key]:.1f}" if key in figures else "" for key in keys]
        lines.append([name, *cells])
    return markdown_table(head, lines)


def first_picture(folder: Path) -> Path:
    """First picture of a test, by name."""
    return min((folder / "pictures").iterdir())


def main() -> None:
    parser = CommandParser(description=__doc__)
    parser.add_argument("--dir", default="demo", help="folder of all outputs")
    parser.add_argument("--budget", choices=BUDGETS, default="demo", help="how long to train")
    parser.add_argument(
        "--models",
        nargs="+",
        action=EachOnce,
        choices=MODELS,
        default=["GSMap"],
        help="models to train, in order",
    )
    parser.add_argument(
        "--from-scratch", action="store_true", help="also train each model from nothing"
    )
    args = parser.parse_args()
    budget = BUDGETS[args.budget]
    folder = Path(args.dir).resolve() / args.budget
    start_s = time.monotonic()
    runs = trainings(args.models, args.from_scratch, folder, budget)
    steps = list(data_steps(folder, budget, "val"))
    for name in args.models:
        steps += shipped_steps(name, folder, budget)
    num_shipped_steps = len(steps)  # after these steps, pictures of the shipped models exist
    steps += data_steps(folder, budget, "train")
    steps.append(prior_step(folder, budget))
    if "MapTR" not in args.models:  # other models start from it, so the table has it
        steps += shipped_steps("MapTR", folder, budget)
    for training in runs:
        steps += training_steps(training, folder, budget)
    for number, step in enumerate(steps, start=1):
        step.run(folder, f"[{number}/{len(steps)}]")
        if number == num_shipped_steps:
            minutes = (time.monotonic() - start_s) / 60
            for name in args.models:
                work = folder / f"shipped_{name.lower()}"
                print(f"\n{minutes:.1f} min: predictions of the {name} that ships:")
                print(f"{first_picture(work)}\n{work / 'report.html'}\n", flush=True)
    shipped_names = dict.fromkeys([*args.models, "MapTR"])  # without repetitions
    summary = table(folder, shipped_names, runs)
    print(f"\nAP in percent on MiniCity's validation towns\n\n{summary}\n")
    write_text(folder / "summary.md", summary + "\n")
    for training in runs:
        print(f"{training.title}: {first_picture(training.test_folder('test'))}")
        print(f"its losses and validations: {training.work / 'curves.png'}")
    print(f"{(time.monotonic() - start_s) / 60:.1f} minutes. Figures: {folder / 'summary.md'}")
    root = data_root(folder, budget, "val")
    print(NEXT.format(activate=Path(sys.prefix, "bin/activate"), root=root))


if __name__ == "__main__":
    run_command(main)
