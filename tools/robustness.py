#!/usr/bin/env python
r"""Measure what a model loses when cameras fail: AP_chamfer over five severities of corruptions.

Writes ``robustness.md``, ``robustness.json`` and ``robustness.png``. Resilience is the mean of AP
over the severities, as a share of that without corruption.

Example:
    python tools/robustness.py gsmap_r18_minicity --data-root data/minicity --samples 50 --out r
"""

import gsmap  # noqa: F401 - first: Ctrl-C is one line from here on, foreign settings are kept out

# isort: split
import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.checkpoints.named_models import checkpoint_for
from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.engine.arguments import add_config_options
from gsmap.utils.cli import CommandParser, run_command
from gsmap.utils.errors import InputError
from gsmap.utils.files import lock_folder, read_json, write_text
from gsmap.utils.progress import Progress
from gsmap.utils.split_lists import require_same_list

KINDS = (
    "camera_lost", "camera_delayed", "rotation", "translation",
    "fog", "rain", "night", "motion_blur", "jpeg",
)  # fmt: skip
SEVERITIES = (1, 2, 3, 4, 5)
CLEAN = "none"
_DELAYED = "camera_delayed"


def parse_args() -> argparse.Namespace:
    parser = CommandParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("config", help="config, by file or name, or the name of a trained model")
    parser.add_argument("checkpoint", nargs="?", help="not needed with the name of a model")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--samples", type=int, help="that many, evenly spread; default: all")
    parser.add_argument("--seed", type=int, default=0, help="of what the corruptions draw")
    parser.add_argument("--out", type=Path, required=True, help="folder of table and plot")
    parser.add_argument(
        "--allow-other-split",
        action="store_true",
        help="score data of another split than that of the training, whose places it may share",
    )
    add_config_options(parser)
    args = parser.parse_args()
    if args.samples is not None and args.samples < 1:
        parser.error(f"--samples must be >= 1, got {args.samples}")
    return args


def corrupted(settings: Any, kind: str, severity: int, seed: int) -> dict[str, Any]:
    """Return a data set's settings with a corruption in the pipeline, where its images are read."""
    if kind == CLEAN:
        return {**settings}
    steps = list(settings["pipeline"])
    (load,) = (i for i, step in enumerate(steps) if step["type"] == "LoadCameraImages")
    step = {"severity": severity, "seed": seed}
    if kind == _DELAYED:
        files = {key: settings[key] for key in ("ann_file", "data_root")}
        steps.insert(load, {"type": "DelayCameras", **files, **step})
    else:
        steps.insert(load + 1, {"type": "CorruptImages", "kind": kind, **step})
    return {**settings, "pipeline": steps}


def average_precisions(model: Any, settings: Any, samples: int | None) -> dict[str, float]:
    """Return AP_chamfer of each class and their mean, in percent."""
    from mmdet3d.registry import DATASETS, METRICS
    from mmengine.dataset import pseudo_collate

    dataset = DATASETS.build(settings)
    metric = METRICS.build({"type": "MapMetric", "eval": ["chamfer"]})
    metric.dataset_meta = dataset.metainfo
    count = min(samples or len(dataset), len(dataset))
    for index in np.linspace(0, len(dataset) - 1, count).round().astype(int).tolist():
        found = model.test_step(pseudo_collate([dataset[index]]))
        metric.process(None, [sample.to_dict() for sample in found])
    figures = metric.evaluate(count)
    keys = {name: f"chamfer/{name}/AP" for name in dataset.metainfo["classes"]}
    return {n: 100 * figures[key] for n, key in {**keys, "mean": "chamfer/mAP"}.items()}


def table(found: dict[str, list[dict[str, float]]]) -> str:
    """Return the table of all corruptions: the mean AP at each severity, and the resilience."""
    rows = [
        f"AP_chamfer without corruption: {found[CLEAN][0]['mean']:.1f}\n",
        f"| corruption | {' | '.join(map(str, SEVERITIES))} | resilience |",
        "| --- " * (len(SEVERITIES) + 2) + "|",
    ]
    for kind, figures in found.items():
        if kind != CLEAN:
            aps = [of["mean"] for of in figures]
            cells = [f"{value:.1f}" for value in aps] + [f"{resilience(found, kind):.0f} %"]
            rows.append(f"| {kind} | {' | '.join(cells)} |")
    return "\n".join(rows) + "\n"


def resilience(found: dict[str, list[dict[str, float]]], kind: str) -> float:
    """Return the mean AP over the severities as a share of that without corruption, in percent."""
    clean = found[CLEAN][0]["mean"]
    return 100 * float(np.mean([of["mean"] for of in found[kind]])) / max(clean, 1e-9)


def earlier_figures(path: Path) -> dict[str, list[dict[str, float]]]:
    """Return the figures of an earlier run into the folder; none without one.

    Raises:
        ValueError: If the file holds anything else.
    """
    if not path.exists():
        return {}
    figures = read_json(path)
    good = isinstance(figures, dict) and all(
        isinstance(rows, list)
        and len(rows) == (1 if kind == CLEAN else len(SEVERITIES))
        and all(isinstance(row, dict) and isinstance(row.get("mean"), float) for row in rows)
        for kind, rows in figures.items()
    )
    if not good or CLEAN not in figures or not {*figures} <= {CLEAN, *KINDS}:
        raise InputError(f"{path} holds no figures of this command: give another --out.")
    return figures


def kept_figures(
    before: dict[str, list[dict[str, float]]],
    clean: list[dict[str, float]],
    args: argparse.Namespace,
) -> dict[str, list[dict[str, float]]]:
    """Return the earlier run's figures of corruptions that this run does not measure.

    Without corruption both must score the same: figures of another model or other samples belong
    into another folder.

    Raises:
        ValueError: If they do not, and figures would be lost.
    """
    others = {kind: rows for kind, rows in before.items() if kind not in {CLEAN, *args.kinds}}
    if others and before[CLEAN] != clean:
        raise InputError(
            f"{args.out} has figures of {', '.join(others)} of another model or other samples "
            f"(AP {before[CLEAN][0]['mean']:.1f} without corruption, here {clean[0]['mean']:.1f}): "
            "give another --out, or name these --kinds too."
        )
    return others


def require_own_split(checkpoint: Path, settings: Any) -> None:
    """Refuse a data set of another split than that of the model's training."""
    from gsmap.checkpoints.reading import read_checked

    meta = AnnotationFile(Path(settings["data_root"], settings["ann_file"])).meta
    trained_on = read_checked(checkpoint).list_of(meta.dataset)
    require_same_list(trained_on, meta.split_list, f"{checkpoint}", "--allow-other-split")


def main() -> str:
    args = parse_args()
    import torch
    from mmengine.logging import MMLogger

    from gsmap.apis.loading import load_model
    from gsmap.visualization.figure import save_figure
    from gsmap.visualization.plots import plot_severities

    checkpoint = checkpoint_for(args.config, args.checkpoint)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    model = load_model(args.config, checkpoint, device, args.cfg_options)
    if not args.allow_other_split:
        require_own_split(checkpoint, model.cfg.test_dataloader.dataset)
    if model.temporal is not None and args.samples:
        raise InputError("--samples tears drives apart, which a model with memory needs whole.")
    MMLogger.get_instance("robustness", log_level="ERROR")  # one table for each run is too much
    cases = [(CLEAN, 1), *((kind, severity) for kind in args.kinds for severity in SEVERITIES)]
    found: dict[str, list[dict[str, float]]] = {}
    with (
        lock_folder(args.out, ".robustness", "wait for its end, or give another --out"),
        Progress(total=len(cases), unit="corruptions") as bar,
        torch.no_grad(),
    ):
        before = earlier_figures(args.out / "robustness.json")
        for kind, severity in cases:
            settings = corrupted(model.cfg.test_dataloader.dataset, kind, severity, args.seed)
            figures = average_precisions(model, settings, args.samples)
            found.setdefault(kind, []).append(figures)
            bar.update(1)
            if kind == CLEAN:
                kept = kept_figures(before, found[CLEAN], args)
        found = {kind: rows for kind in (CLEAN, *KINDS) if (rows := {**kept, **found}.get(kind))}
        text = table(found)
        write_text(args.out / "robustness.json", json.dumps(found, indent=1) + "\n")
        write_text(args.out / "robustness.md", text)
        means = {kind: [of["mean"] for of in figures] for kind, figures in found.items()}
        clean = means.pop(CLEAN)[0]
        save_figure(plot_severities(means, clean, SEVERITIES), args.out / "robustness.png")
    return f"{text}\nfiles: {args.out}"


if __name__ == "__main__":
    run_command(main)
