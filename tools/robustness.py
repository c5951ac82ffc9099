#!/usr/bin/env python
r"""Measure the loss of accuracy when cameras fail: AP_chamfer at five severities of corruptions.

Writes ``robustness.md``, ``robustness.json`` and ``robustness.png``. Resilience is the mean AP over
the severities, divided by the AP without corruption.

Example:
    python tools/robustness.py gsmap_r18_minicity --data-root data/minicity --samples 50 --out r
"""

# Imported before all libraries: this handles Ctrl-C during their imports, and keeps them from
# reading settings files in the working folder.
import gsmap  # noqa: F401

# isort: split
import argparse
import json
from collections.abc import Mapping, Sequence
from itertools import product
from math import isnan
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.checkpoints.named_models import checkpoint_for
from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.engine.arguments import add_config_options
from gsmap.utils.cli import CommandParser, EachOnce, run_command
from gsmap.utils.errors import InputError
from gsmap.utils.files import lock_folder, read_json, write_text
from gsmap.utils.progress import Progress
from gsmap.utils.split_lists import require_same_list
from gsmap.utils.words import markdown_table

KINDS = (
    "camera_lost", "camera_delayed", "rotation", "translation",
    "fog", "rain", "night", "motion_blur", "jpeg",
)  # fmt: skip
SEVERITIES = (1, 2, 3, 4, 5)
CLEAN = "none"  # key of the figures without corruption, which are measured once
_DELAYED = "camera_delayed"
_OF_SEVERAL_CAMERAS = ("camera_lost", _DELAYED)  # their severity is a number of cameras


def parse_args() -> argparse.Namespace:
    parser = CommandParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("config", help="config, by file or name, or the name of a trained model")
    parser.add_argument("checkpoint", nargs="?", help="not needed with the name of a model")
    parser.add_argument("--kinds", nargs="+", action=EachOnce, choices=KINDS, default=list(KINDS))
    parser.add_argument("--samples", type=int, help="number of samples, evenly spread (all)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the random corruptions")
    parser.add_argument("--out", type=Path, required=True, help="folder of table and plot")
    parser.add_argument(
        "--allow-other-split",
        action="store_true",
        help="score data of another split than the training split, although they may share places",
    )
    add_config_options(parser)  # --cfg-options, --data-root and --image-scale
    args = parser.parse_args()
    if args.samples is not None and args.samples < 1:
        parser.error(f"--samples must be >= 1, got {args.samples}")
    return args


def add_corruption(settings: Any, kind: str, severity: int, seed: int) -> dict[str, Any]:
    """Settings of a data set with a corruption in its pipeline.

    The delay of cameras replaces the paths of the images, so it is inserted before the step that
    loads them. Other corruptions change the loaded images.

    Args:
        settings: Settings of the data set in a config.
        kind: One of ``KINDS``, or ``CLEAN`` for no corruption.
        severity: Severity of the corruption, 1 to 5.
        seed: Seed of the random numbers.

    Raises:
        ValueError: If the pipeline has no step ``LoadCameraImages``.
    """
    if kind == CLEAN:
        return dict(settings)
    steps = list(settings["pipeline"])
    types = [step["type"] for step in steps]
    if "LoadCameraImages" not in types:
        raise InputError(
            f"the test pipeline {types} has no step LoadCameraImages, whose images are corrupted: "
            "give a config that loads images by it."
        )
    load_index = types.index("LoadCameraImages")
    if kind == _DELAYED:
        step = {
            "type": "DelayCameras",
            "ann_file": settings["ann_file"],
            "data_root": settings["data_root"],
            "severity": severity,
            "seed": seed,
        }
        steps.insert(load_index, step)
    else:
        step = {"type": "CorruptImages", "kind": kind, "severity": severity, "seed": seed}
        steps.insert(load_index + 1, step)
    return {**settings, "pipeline": steps}


def measured_indices(dataset: Any, samples: int | None) -> list[int]:
    """Indices of the samples that are measured.

    Args:
        dataset: The data set.
        samples: Number of samples, evenly spread; None for all.
    """
    count = min(samples or len(dataset), len(dataset))
    places = np.linspace(0, len(dataset) - 1, count)
    return places.round().astype(int).tolist()


def severities_of(kinds: Sequence[str], dataset: Any, indices: Sequence[int]) -> dict[str, int]:
    """Largest severity of each kind of corruption that all measured samples allow; 0 for none.

    As many cameras as the severity are lost or delayed, and one camera must remain. The first
    sample of a scene has no earlier one to delay cameras by.

    Args:
        kinds: Kinds of corruptions, of ``KINDS``.
        dataset: The data set.
        indices: Indices of the measured samples.
    """
    counts = []  # number of cameras of each sample
    for index in indices:
        names = [camera.name for camera in dataset.sample(index).cameras]
        if dataset.cameras is not None:
            names = [name for name in names if name in dataset.cameras]
        counts.append(len(names))
    largest = max(min(counts) - 1, 0)
    first_samples = {scene[0] for scene in dataset.scenes()}
    severities = {}
    for kind in kinds:
        severities[kind] = SEVERITIES[-1]
        if kind in _OF_SEVERAL_CAMERAS:
            severities[kind] = min(largest, SEVERITIES[-1])
        if kind == _DELAYED and first_samples.issuperset(indices):
            severities[kind] = 0
    return severities


def notes_on(severities: Mapping[str, int]) -> list[str]:
    """Sentences on the kinds of corruptions that are measured at few severities or at none.

    Args:
        severities: Largest severity of each kind, 0 for none.

    Raises:
        ValueError: If no kind can be measured.
    """
    notes = []
    for kind, largest in severities.items():
        if largest == 0:
            notes.append(
                f"{kind} is left out: it needs several cameras in all samples, and camera_delayed "
                "also samples that are not the first of their scenes."
            )
        elif largest < SEVERITIES[-1]:
            notes.append(
                f"{kind} has no figures above severity {largest}, as a sample has only "
                f"{largest + 1} cameras."
            )
    if not any(severities.values()):
        raise InputError(f"nothing to measure: {' '.join(notes)} Give other --kinds.")
    return notes


def average_precisions(model: Any, settings: Any, samples: int | None) -> dict[str, float]:
    """AP_chamfer of each class, and ``mean``, in percent.

    Args:
        model: The model.
        settings: Settings of the data set.
        samples: Number of samples, evenly spread; None for all.
    """
    from mmdet3d.registry import DATASETS, METRICS
    from mmengine.dataset import pseudo_collate

    model.eval()  # empties the memory and the maps of the previous case
    dataset = DATASETS.build(settings)
    metric = METRICS.build({"type": "MapMetric", "eval": ["chamfer"]})
    metric.dataset_meta = dataset.metainfo  # classes and range, which a runner would set
    indices = measured_indices(dataset, samples)
    for index in indices:
        batch = pseudo_collate([dataset[index]])
        predictions = [sample.to_dict() for sample in model.test_step(batch)]
        # The metric reads only the predictions, with their ground truth, and not the input batch.
        metric.process(None, predictions)
    figures = metric.evaluate(len(indices))  # all samples that were processed
    aps = {}
    for name in dataset.metainfo["classes"]:
        aps[name] = 100 * figures[f"chamfer/{name}/AP"]
    aps["mean"] = 100 * figures["chamfer/mAP"]
    return aps


def mean_aps(figures: dict[str, list[dict[str, float]]], kind: str) -> list[float]:
    """Mean AP at each severity of a corruption, in percent.

    Args:
        figures: AP of each class, and ``mean``, at each severity, by corruption (``KINDS`` or
            ``CLEAN``).
        kind: The corruption.
    """
    return [at_severity["mean"] for at_severity in figures[kind]]


def resilience(figures: dict[str, list[dict[str, float]]], kind: str) -> float:
    """Mean AP over the severities as a share of the AP without corruption, in percent.

    NaN if the AP without corruption is 0, or not all severities have an AP.
    """
    (clean,) = mean_aps(figures, CLEAN)  # a list of one value
    aps = mean_aps(figures, kind)
    if clean > 0 and len(aps) == len(SEVERITIES):
        mean_ap = float(np.mean(aps))
        return 100 * mean_ap / clean
    return float("nan")


def table(figures: dict[str, list[dict[str, float]]]) -> str:
    """Markdown table of all corruptions: mean AP at each severity, and resilience."""
    (clean,) = mean_aps(figures, CLEAN)
    heads = ["corruption", *(str(severity) for severity in SEVERITIES), "resilience"]
    rows = []
    for kind in figures:
        if kind == CLEAN:
            continue
        cells = [f"{ap:.1f}" for ap in mean_aps(figures, kind)]
        cells += ["-"] * (len(SEVERITIES) - len(cells))
        share = resilience(figures, kind)
        last_cell = "-" if isnan(share) else f"{share:.0f} %"
        rows.append([kind, *cells, last_cell])
    return f"AP_chamfer without corruption: {clean:.1f}\n\n{markdown_table(heads, rows)}\n"


def earlier_figures(path: Path) -> dict[str, list[dict[str, float]]]:
    """Figures of an earlier run in the output folder; empty without an earlier run.

    Raises:
        ValueError: If the file has other contents.
    """
    if not path.exists():
        return {}
    figures = read_json(path)
    if not are_figures(figures):
        raise InputError(f"{path} holds no figures of this command: give another --out.")
    return figures


def are_figures(content: Any) -> bool:
    """Whether the content of a file has the form of figures of this command.

    It has a list by corruption, with one dictionary of AP for each severity that was measured.
    """
    if not isinstance(content, dict) or CLEAN not in content:
        return False
    for kind, rows in content.items():
        smallest = 1 if kind in (CLEAN, *_OF_SEVERAL_CAMERAS) else len(SEVERITIES)
        largest = 1 if kind == CLEAN else len(SEVERITIES)
        if kind not in (CLEAN, *KINDS) or not isinstance(rows, list):
            return False
        if not smallest <= len(rows) <= largest:
            return False
        for row in rows:
            if not isinstance(row, dict) or not isinstance(row.get("mean"), float):
                return False
    return True


def other_figures(
    earlier: dict[str, list[dict[str, float]]],
    clean: list[dict[str, float]],
    args: argparse.Namespace,
) -> dict[str, list[dict[str, float]]]:
    """Earlier figures of the corruptions that this run does not measure.

    Args:
        earlier: All figures of the earlier run.
        clean: Figures of this run without corruption, and its ``seed``. If they equal the earlier
            ones, both runs are taken to have one model and equal samples.
        args: The options of the command.

    Raises:
        ValueError: If the figures without corruption or the seeds differ, so that earlier ones
            would be lost.
    """
    measured_kinds = {CLEAN, *args.kinds}
    others = {}
    for kind, rows in earlier.items():
        if kind not in measured_kinds:
            others[kind] = rows
    if not others:
        return others
    # Files of earlier versions have no seed: it is taken to be the default.
    before = {"seed": 0, **earlier[CLEAN][0]}
    if before != clean[0]:
        raise InputError(
            f"{args.out} has figures of {', '.join(others)} of another model, other samples or "
            f"another seed (AP {before['mean']:.1f} without corruption and seed "
            f"{before['seed']:.0f}, here {clean[0]['mean']:.1f} and {clean[0]['seed']:.0f}): give "
            "another --out, or name these --kinds too."
        )
    return others


def require_own_split(checkpoint: Path, settings: Any) -> None:
    """Raise an error if the model was trained on another split list than the data set has.

    A split list is the list of scenes that defines the splits of a data set.

    Args:
        checkpoint: File of the weights, which names the split list of the training.
        settings: Settings of the data set in a config.

    Raises:
        ValueError: If both lists are known and differ.
    """
    from gsmap.checkpoints.reading import read_checked

    meta = AnnotationFile(Path(settings["data_root"], settings["ann_file"])).meta
    # Empty if the checkpoint names no list, or was trained on another data set.
    trained_on = read_checked(checkpoint).list_of(meta.dataset)
    require_same_list(trained_on, meta.split_list, f"{checkpoint}", "--allow-other-split")


def main() -> str:
    args = parse_args()
    import torch
    from mmdet3d.registry import DATASETS
    from mmengine.logging import MMLogger

    from gsmap.apis.loading import load_model
    from gsmap.apis.trained_cameras import use_cameras_of
    from gsmap.visualization.figure import save_figure
    from gsmap.visualization.plots import plot_severities

    # Without a checkpoint in the options, this is the checkpoint of the named model.
    checkpoint = checkpoint_for(args.config, args.checkpoint)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    model = load_model(args.config, checkpoint, device=device, cfg_options=args.cfg_options)
    if model.img_backbone is None:
        raise InputError(f"{args.config} uses no images to corrupt: give a model with cameras.")
    if not args.allow_other_split:
        require_own_split(checkpoint, model.cfg.test_dataloader.dataset)
    if model.temporal is not None and args.samples:
        raise InputError(
            "--samples takes single samples out of the drives, but this model uses earlier frames "
            "and needs whole drives: leave it out."
        )
    # Without a logger of this level, the metric would log a table for each case.
    MMLogger.get_instance("robustness", log_level="ERROR")
    dataset = DATASETS.build(model.cfg.test_dataloader.dataset)
    use_cameras_of(model, dataset)
    indices = measured_indices(dataset, args.samples)
    severities = severities_of(args.kinds, dataset=dataset, indices=indices)
    notes = notes_on(severities)
    cases = [(CLEAN, 1)]
    for kind, severity in product(args.kinds, SEVERITIES):
        if severity <= severities[kind]:
            cases.append((kind, severity))
    measured: dict[str, list[dict[str, float]]] = {}
    with (
        # No other process may write to the folder until the end of this context.
        lock_folder(args.out, ".robustness", "wait for its end, or give another --out"),
        Progress(total=len(cases), unit="corruptions") as bar,
        torch.no_grad(),
    ):
        earlier = earlier_figures(args.out / "robustness.json")
        for kind, severity in cases:
            settings = add_corruption(
                model.cfg.test_dataloader.dataset, kind, severity=severity, seed=args.seed
            )
            aps = average_precisions(model, settings, args.samples)
            measured.setdefault(kind, []).append(aps)
            bar.update(1)
            if kind == CLEAN:  # the first case, so that an error comes before the long measurement
                aps["seed"] = args.seed  # of the corruptions, which later runs compare
                others = other_figures(earlier, measured[CLEAN], args)
        measured.update(others)
        # In a fixed order, whether they were measured now or in an earlier run.
        figures = {}
        for kind in (CLEAN, *KINDS):
            if kind in measured:
                figures[kind] = measured[kind]
        text = table(figures)
        write_text(args.out / "robustness.json", json.dumps(figures, indent=1) + "\n")
        write_text(args.out / "robustness.md", text)
        means = {kind: mean_aps(figures, kind) for kind in figures}
        (clean,) = means.pop(CLEAN)
        figure = plot_severities(means, clean, SEVERITIES)
        save_figure(figure, args.out / "robustness.png")
    return "\n".join([text, *notes, f"files: {args.out}"])


if __name__ == "__main__":
    run_command(main)
