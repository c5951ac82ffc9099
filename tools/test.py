#!/usr/bin/env python
"""Test a model: ``python tools/test.py CONFIG CHECKPOINT --eval chamfer raster``.

Or give the name of a model that ships: ``python tools/test.py gsmap_r18_minicity``.
"""

# Imported before all libraries: this handles Ctrl-C during their imports, and keeps them from
# reading settings files in the working folder.
import gsmap  # noqa: F401

# isort: split
import argparse
import json
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from mmengine.config import Config

from gsmap.checkpoints.named_models import checkpoint_for
from gsmap.engine.arguments import add_common_arguments
from gsmap.utils.cli import CommandParser, output_file, run_command
from gsmap.utils.errors import InputError
from gsmap.utils.files import write_text
from gsmap.utils.interrupt import is_first_rank


def parse_args() -> argparse.Namespace:
    parser = CommandParser(description=__doc__)
    parser.add_argument("config", help="config, by file or name, or the name of a trained model")
    parser.add_argument(
        "checkpoint",
        nargs="?",
        help="checkpoint, ours or MapTR's; not needed with the name of a trained model",
    )
    parser.add_argument(
        "--eval",
        nargs="*",
        metavar="METRIC",
        help="metrics by name (default: those of the config, or chamfer and raster); without a "
        "name after it, the predictions are only written to --out",
    )
    parser.add_argument(
        "--out", type=output_file, metavar="FILE.json", help="write the predictions (MapTR's form)"
    )
    parser.add_argument(
        "--metrics-out", type=output_file, metavar="FILE.json", help="write the metrics"
    )
    parser.add_argument("--show-dir", metavar="DIR", help="draw the samples into this folder")
    parser.add_argument(
        "--show-interval", type=int, default=1, metavar="N", help="draw every N-th sample"
    )
    parser.add_argument(
        "--shuffle-images",
        type=int,
        metavar="SEED",
        help="give every sample the images of another one, to measure the score without them",
    )
    parser.add_argument(
        "--allow-other-split",
        action="store_true",
        help="score data of another split than the training split, although they may share places",
    )
    parser.add_argument(
        "--prior",
        nargs="+",
        type=Path,
        default=[],
        metavar="FILE",
        help="maps of earlier drives, one for each place, for a model that reads them",
    )
    add_common_arguments(parser)
    return parser.parse_args()


def metric_settings(cfg: Config) -> list[dict[str, Any]]:
    """Settings of the metrics of the test, with `MapMetric` or a metric derived from it first."""
    from mmdet3d.registry import METRICS

    from gsmap.engine.targets import class_of_type
    from gsmap.evaluation.map_metric import MapMetric

    metrics = cfg.get("test_evaluator") or []
    if isinstance(metrics, dict):
        metrics = metrics.get("metrics", {"type": "MapMetric", **metrics})
    if isinstance(metrics, dict):
        metrics = [metrics]
    first: list[dict[str, Any]] = []
    others: list[dict[str, Any]] = []
    for metric in metrics:
        metric_class = class_of_type(metric.get("type"), registry=METRICS) or object
        (first if issubclass(metric_class, MapMetric) else others).append(metric)
    return [*(first or [{"type": "MapMetric"}]), *others]


def apply_options(cfg: Config, args: argparse.Namespace) -> None:
    """Apply the options of this command to the config, in place."""
    cfg.resume = False  # only weights are loaded, not the state of a training
    map_metric, *others = metric_settings(cfg)
    map_metric = dict(map_metric)
    if args.eval is not None:
        map_metric["eval"] = args.eval
    if args.out:
        map_metric["out_file"] = str(args.out)
    # `GaussianMetric` adds statistics of predicted Gaussians.
    if all(metric.get("type") != "GaussianMetric" for metric in others):
        others.append({"type": "GaussianMetric"})
    cfg.test_evaluator = [map_metric, *others]
    if args.allow_other_split:
        cfg.default_hooks.checkpoint.allow_other_split = True
    if args.show_dir:
        cfg.default_hooks.visualization.update(
            draw=True,
            interval=args.show_interval,
            test_out_dir=str(Path(args.show_dir).resolve()),
        )
    if args.shuffle_images is not None:
        cfg.test_dataloader.dataset.shuffle_images_seed = args.shuffle_images


def plain_value(value: Any) -> Any:
    """Convert a value of a user's metric for JSON: numbers and arrays stay numbers, else a text."""
    return value.tolist() if hasattr(value, "tolist") else str(value)


def describe_priors(runner: Any, priors: list[Any], paths: list[Path]) -> None:
    """Pass facts of the priors to the result file, and warn if they were made of the samples.

    Args:
        runner: The test.
        priors: The priors.
        paths: Their files.
    """
    from gsmap.apis.map_priors import facts_of_priors, leak_warnings
    from gsmap.engine.run_log import innermost
    from gsmap.utils.model_facts import PRIORS

    loop = runner.test_loop
    tokens = []
    for dataset in innermost(loop.dataloader.dataset):
        if hasattr(dataset, "tokens"):  # not a data set class of a user
            tokens += dataset.tokens()
    facts = facts_of_priors(priors, paths, tokens)
    for line in leak_warnings(facts, len(tokens)):
        runner.logger.warning(line)
    loop.evaluator.dataset_meta = {**(loop.evaluator.dataset_meta or {}), PRIORS: facts}


def main() -> None:
    args = parse_args()
    if args.eval == [] and not args.out:
        raise InputError("Nothing to do: name a metric after --eval, or a file after --out.")
    from mmengine.model import is_model_wrapper

    from gsmap.apis.loading import zero_signals_note
    from gsmap.apis.map_priors import empty_reads, use_priors
    from gsmap.apis.trained_cameras import TrainedCamerasHook
    from gsmap.checkpoints.building import building
    from gsmap.checkpoints.reading import adopt_settings, read_checked
    from gsmap.checkpoints.settings import dataset_of
    from gsmap.engine.launch import load_config
    from gsmap.engine.map_agreement import check_map_agreement
    from gsmap.engine.run_log import MapRunner

    checkpoint = checkpoint_for(args.config, args.checkpoint)
    cfg = load_config(args, for_training=False)
    dataset_of(cfg, "test")  # raises an error if there is none
    # The model gets the settings with which the checkpoint was trained. Notes name the changes.
    contents = read_checked(checkpoint)
    notes = adopt_settings(cfg, checkpoint, args.cfg_options, checkpoint=contents)
    cfg.load_from = str(checkpoint)
    apply_options(cfg, args)
    if notes and is_first_rank():  # one of several processes prints
        print("\n".join(notes))
    check_map_agreement(cfg, "test")  # of the checkpoint's model
    # `building` adds the names of the config's parts to errors. The stack closes the priors.
    with building(cfg), ExitStack() as stack:
        runner = MapRunner.from_cfg(cfg)
        runner.register_hook(TrainedCamerasHook(args.config, checkpoint, contents))
        # In a distributed test, the model is within a wrapper.
        model = runner.model.module if is_model_wrapper(runner.model) else runner.model
        if note := zero_signals_note(model, cfg):
            runner.logger.warning(note)
        priors = []
        if args.prior:
            priors = use_priors(model, args.prior, stack)
            describe_priors(runner, priors, args.prior)
        metrics = runner.test()
        for line in empty_reads(priors):
            runner.logger.warning(line)
    if args.metrics_out and runner.rank == 0:
        write_text(args.metrics_out, json.dumps(metrics, indent=2, default=plain_value))


if __name__ == "__main__":
    # After ``kill``, a rank ends at once: its clean-up would wait for the other ranks.
    run_command(main, clean_up_on_kill=False)
