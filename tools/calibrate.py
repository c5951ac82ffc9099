#!/usr/bin/env python
r"""Fit the sigmas of a model's Gaussians to its errors, and write a calibrated checkpoint.

RESULTS are predictions of this checkpoint on samples that are not in its training. For each class,
the fit gives a factor for sigma along the line and a factor for sigma across it. After sigma is
multiplied by its factor, 68.3 % of the errors lie within one sigma or, with ``--sigmas 2``, 95.4 %
within two. ``--law laplace`` assumes a Laplace distribution, which has longer tails. Then 68.3 % of
the errors lie within 0.81 sigma or, with ``--sigmas 2``, 95.4 % within 2.18 sigma. The law and the
number of sigmas are recorded as ``calibration`` in the meta of the checkpoint and in its results.

Results of another checkpoint are refused, and so are samples of the split of the training.

Example:
    python tools/test.py gsmap_r18_minicity --eval --out half.json \
        --cfg-options test_dataloader.dataset.indices=200
    python tools/calibrate.py gsmap_r18_minicity gsmap_r18_minicity half.json \
        gsmap_minicity_val.arrow calibrated.pth
"""

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.evaluation.analysis.calibration import LAWS, fit_factors, matched_vertices
from gsmap.evaluation.core.chamfer_ap import ChamferConfig
from gsmap.evaluation.core.file_evaluation import SamplePairs, joined_notes
from gsmap.utils.cli import CommandParser, output_file, run_command
from gsmap.utils.errors import InputError
from gsmap.utils.files import atomic_write
from gsmap.utils.model_facts import CALIBRATION, CHECKPOINT
from gsmap.utils.shards import digest


def parse_args() -> argparse.Namespace:
    parser = CommandParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("config", help="config, by file or name, or the name of a trained model")
    parser.add_argument("checkpoint", help="checkpoint of the model, by file or name")
    parser.add_argument("results", type=Path, help="its predictions (tools/test.py --out)")
    parser.add_argument(
        "ground_truth", type=Path, help="annotation file (*.arrow), or JSON with a list of GTs"
    )
    parser.add_argument("target", type=output_file, help="checkpoint to write; must not exist")
    parser.add_argument(
        "--sigmas",
        type=float,
        default=1.0,
        help="interval that gets its coverage: 1 for 68.3 %% of the errors, 2 for 95.4 %%",
    )
    parser.add_argument("--law", choices=LAWS, default="normal", help="distribution of the errors")
    args = parser.parse_args()
    if not 0 < args.sigmas <= 3:
        parser.error(f"--sigmas must be more than 0 and at most 3, got {args.sigmas:g}")
    return args


def require_held_out(trained: Mapping[str, Any], train_file: str, ground_truth: Path) -> None:
    """Refuse samples of the split that the model was trained on, if both splits are known.

    Args:
        trained: Metadata of the training's data set. Checkpoints that ship have none.
        train_file: Annotation file of the training in the config, used without metadata.
        ground_truth: Ground truth of the samples.

    Raises:
        ValueError: If the samples are of the training.
    """
    if ground_truth.suffix.lower() != ".json":  # a JSON file names no split
        meta = AnnotationFile(ground_truth).meta
        is_of_training = Path(train_file).name == ground_truth.name
        if trained:
            trained_split = (trained.get("dataset"), trained.get("split"))
            is_of_training = trained_split == (meta.dataset, meta.split)
        if is_of_training:
            raise InputError(
                f"{ground_truth} holds the split {meta.split!r}, which the model was trained on: "
                "its errors there are smaller than elsewhere; give results of another split."
            )


def main() -> str:
    args = parse_args()
    if args.target.exists():
        raise FileExistsError(f"{args.target} exists already: choose another name or remove it.")
    import torch
    from mmdet3d.registry import MODELS

    from gsmap.checkpoints.building import building
    from gsmap.checkpoints.named_models import find_checkpoint
    from gsmap.checkpoints.reading import adopt_settings, read_checked
    from gsmap.checkpoints.settings import IMAGE_SIZE, MODEL_SETTINGS, SIGNALS, plain
    from gsmap.engine.launch import read_config

    cfg = read_config(args.config)
    source = read_checked(args.checkpoint)
    train_data = (cfg.get("train_dataloader") or {}).get("dataset", {})
    train_file = str(train_data.get("ann_file", ""))
    require_held_out(source.dataset_meta, train_file, args.ground_truth)
    with building(cfg):  # adds the name of the config to errors
        # The config gets the model settings with which the checkpoint was trained. A calibrated
        # checkpoint has the factors of its sigmas as `temperatures` of the head.
        adopt_settings(cfg, args.checkpoint, None)
        if cfg.model.map_head.get("temperatures"):
            raise InputError(
                f"{args.checkpoint} is calibrated already: give the checkpoint it was made from."
            )
        classes = tuple(cfg.model.classes)
        model = MODELS.build(cfg.model)
        if "scales" not in model.map_head.reference.outputs:
            raise InputError(f"{args.config} has no Gaussians: give a config of GSMap.")
        # With `allow_mismatch`, the results may be of a part of the samples, as in the example.
        pairs = SamplePairs(
            args.results, args.ground_truth, classes, allow_mismatch=True, gaussians=True
        )
        # Errors and sigmas of the vertices of all predictions that match a ground truth. This reads
        # the results, so `about` has their metadata afterwards.
        vertices = matched_vertices(pairs, ChamferConfig(classes))
        checkpoint_digest = pairs.about.get(CHECKPOINT)  # None in files of earlier versions
        if checkpoint_digest not in (None, digest(find_checkpoint(args.checkpoint))):
            raise InputError(
                f"{args.results} was made with another checkpoint than {args.checkpoint}: give "
                "this one's predictions (tools/test.py --out)."
            )
        # Factors along and across the line. (classes, 2)
        factors = fit_factors(vertices, classes, args.sigmas, args.law)
        cfg.model.map_head.temperatures = factors.round(4).tolist()
    meta: dict[str, Any] = {  # read when the checkpoint is loaded or tested
        MODEL_SETTINGS: json.dumps(plain(cfg.model.to_dict())),
        CALIBRATION: {"law": args.law, "sigmas": args.sigmas},
    }
    if source.can_bus or source.without_signals:  # otherwise it is unknown
        meta[SIGNALS] = source.can_bus
    if source.dataset_meta:  # with it, a test can warn about samples of the training's split
        meta["dataset_meta"] = dict(source.dataset_meta)
    if source.image_size:
        meta[IMAGE_SIZE] = source.image_size
    with atomic_write(args.target, "wb") as file:
        torch.save({"state_dict": source.state, "meta": meta}, file)
    lines = []
    for name, (along, across) in zip(classes, factors, strict=True):
        lines.append(f"{name}: sigma {along:.2f} times along, {across:.2f} times across")
    lines += joined_notes(pairs.notes(counts_heights=False))
    lines.append(f"by the {args.law} law, {args.sigmas:g} sigma: {args.target}")
    return "\n".join(lines)


if __name__ == "__main__":
    run_command(main)
