#!/usr/bin/env python
"""Score the "same map everywhere" prior: the best fixed set of elements, fitted on a training set.

Example: ``python tools/map_prior.py annotations_train.arrow annotations_val.arrow``.
"""

import argparse
import json
import sys
import time
from pathlib import Path

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.evaluation.chamfer_ap import ChamferConfig
from gsmap.evaluation.evaluator import (
    METRIC_NAMES,
    EvaluationConfig,
    MapEvaluator,
    flat_metrics,
)
from gsmap.evaluation.file_evaluation import ArrowElements
from gsmap.evaluation.prior import PriorConfig, fit_prior
from gsmap.evaluation.raster_ap import RasterConfig
from gsmap.evaluation.report import MetricReport, format_table
from gsmap.structures.elements import MapElements


def parse_args(argv: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("train", type=Path, help="annotation file that the prior is fitted on")
    parser.add_argument("val", type=Path, help="annotation file that it is scored on")
    parser.add_argument("--eval", nargs="+", default=list(METRIC_NAMES), choices=METRIC_NAMES)
    parser.add_argument("--max-samples", type=int, default=2000, help="training samples to use")
    parser.add_argument("--max-elements", type=int, default=50, help="elements in the set")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="write the figures and the elements as JSON")
    return parser.parse_args(argv)


def read(path: Path, classes: tuple[str, ...], limit: int | None = None) -> list[MapElements]:
    """Read the ground truth of a file, evenly thinned out to at most ``limit`` samples."""
    source = ArrowElements(path, classes)
    number = len(source.tokens)
    step = max(1, -(-number // limit)) if limit else 1
    return source.elements(range(0, number, step))[0]


def score(
    prior: MapElements, truth: list[MapElements], config: EvaluationConfig
) -> list[MetricReport]:
    evaluator = MapEvaluator(config)
    for i, ground_truth in enumerate(truth):
        evaluator.update(f"{i:09d}", prior, ground_truth)
    return evaluator.compute()


def main(argv: list[str] | None = None) -> int:
    args = parse_args(argv)
    start = time.perf_counter()
    try:
        train_meta, meta = AnnotationFile(args.train).meta, AnnotationFile(args.val).meta
        if train_meta.classes != meta.classes:
            raise ValueError(f"the classes differ: {train_meta.classes} and {meta.classes}.")
        chamfer = ChamferConfig(meta.classes)
        raster = RasterConfig(meta.classes, x_range=meta.x_range, y_range=meta.y_range)
        config = EvaluationConfig(
            chamfer if "chamfer" in args.eval else None, raster if "raster" in args.eval else None
        )
        train = read(args.train, meta.classes, args.max_samples)
        settings = PriorConfig(max_elements=args.max_elements, seed=args.seed)
        say = lambda line: print(f"[{time.perf_counter() - start:5.1f} s] {line}", flush=True)  # noqa: E731
        say(f"fitting on {len(train)} training samples")
        prior = fit_prior(train, chamfer, settings, say)
        found = score(prior, read(args.val, meta.classes), config)
        on_train = score(prior, train, EvaluationConfig(chamfer, None))
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    for report in found:
        print("\n" + format_table(report))
    fitted = flat_metrics(on_train)["chamfer/mAP"]
    print(f"\n{len(prior)} elements; mAP_chamfer on the training samples: {fitted:.6f}")
    if args.out:
        elements = [
            {
                "pts": prior.polylines[i].tolist(),
                "cls_name": meta.classes[prior.labels[i]],
                "confidence_level": float(prior.scores[i]),
            }
            for i in range(len(prior))
        ]
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(json.dumps({"metrics": flat_metrics(found), "vectors": elements}))
        print(f"figures and elements: {args.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
