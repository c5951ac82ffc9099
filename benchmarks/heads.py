"""Ablate the map head alone, on stored BEV features of a common checkpoint, in paired runs.

Backbone, neck and BEV encoder are frozen. They run once for each sample, and their features are
stored, so a run costs a fraction of fine-tuning the whole model; the data pipeline must not augment
images. Every variant starts from the head of the checkpoint or, with ``--from-scratch``, from
random weights. All variants are trained on equal batches in equal order, and tested on equal
features. ``python -m benchmarks shape`` reads their predictions, ``NAME-SEED/results.json``.
"""

import argparse
import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from mmdet3d.registry import DATASETS, METRICS, MODELS
from mmengine.config import Config
from mmengine.dataset import pseudo_collate
from mmengine.logging import MMLogger
from torch.optim.lr_scheduler import CosineAnnealingLR, LinearLR, SequentialLR

from benchmarks.measure import markdown_table
from gsmap.checkpoints.building import building
from gsmap.checkpoints.reading import load_weights
from gsmap.datasets.annotations.record import CLASSES
from gsmap.engine.arguments import parse_options
from gsmap.engine.launch import read_config
from gsmap.evaluation.core.report import UNDEFINED
from gsmap.utils.errors import InputError
from gsmap.utils.files import atomic_write, write_text
from gsmap.utils.parallel import ordered_map

METRIC_NAMES = ("chamfer", "raster")  # APs with matches by Chamfer distance, and by raster IoU
WARM_UP = 100  # iterations
# Options that the stored features depend on.
_FEATURE_OPTIONS = ("config", "checkpoint", "data_root")
# Options that the figures (values of the metrics) depend on. The seed is not among them, because it
# is part of the file names.
_FIGURE_OPTIONS = (*_FEATURE_OPTIONS, "iterations", "batch", "lr", "from_scratch")


@dataclass(frozen=True)
class Task:
    """Training and test of one head.

    Attributes:
        config: Config file of the model with the head.
        options: Overrides of the config, by dotted key.
        seed: Seed of new weights and of the order of the batches.
        results: File to write the predictions of the val split to.
    """

    config: Path
    options: dict[str, Any]
    seed: int
    results: Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``benchmarks heads`` to a parser."""
    parser.add_argument("config", type=Path, help="config of backbone, encoder and data")
    parser.add_argument("checkpoint", help="checkpoint of the config, or name of a model")
    parser.add_argument(
        "variants", type=Path, help='JSON file, {"name": "CONFIG KEY=VALUE ...", ...}'
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of features and figures")
    parser.add_argument("--data-root", required=True)
    parser.add_argument("--iterations", type=int, default=1600)
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--lr", type=float, default=3e-4)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument(
        "--from-scratch",
        action="store_true",
        help="start from random weights of the head, not from the checkpoint",
    )
    parser.add_argument("--workers", type=int, default=1, help="runs at the same time")


def run(args: argparse.Namespace) -> None:
    """Store the features, train and test every variant, and print a table.

    Features and figures that are already in the output folder are used again, so an interrupted
    command continues.

    Args:
        args: Parsed options of ``add_arguments``.

    Raises:
        ValueError: If the output folder has features or figures of other settings.
    """
    # Config file and overrides of each variant, as one text, by the name of the variant.
    variants: dict[str, str] = json.loads(args.variants.read_text())
    settings = _option_values(args, _FIGURE_OPTIONS)
    feature_files = {"train": args.out / "train.pt", "val": args.out / "val.pt"}
    feature_settings = args.out / "settings.json"
    if feature_files["train"].exists() and not feature_settings.exists():
        raise InputError(f"{args.out} holds features of unknown settings: give another --out.")
    settings_of_file = {feature_settings: _option_values(args, _FEATURE_OPTIONS)}
    for name, variant in variants.items():
        path = args.out / f"{name}.settings.json"
        settings_of_file[path] = {**settings, "variant": variant}
    record_settings(settings_of_file)
    options = {"data_root": str(args.data_root)}  # the data root of each split
    for split, path in feature_files.items():
        if not path.exists():
            cfg = read_config(args.config, options)
            store_features(cfg, args.checkpoint, part=split, path=path)
    # Both dictionaries have the keys (name of the variant, seed).
    figures: dict[tuple[str, int], dict[str, float]] = {}
    tasks: dict[tuple[str, int], Task] = {}
    for name, variant in variants.items():
        config, *overrides = shlex.split(variant)  # "CONFIG KEY=VALUE ..."
        for seed in range(args.seeds):
            path = args.out / f"{name}-{seed}.json"
            if path.exists():
                figures[name, seed] = json.loads(path.read_text())
                continue
            tasks[name, seed] = Task(
                config=Path(config),
                options=parse_options(overrides) if overrides else {},
                seed=seed,
                results=args.out / f"{name}-{seed}/results.json",
            )
    train = partial(train_and_test, args=args, features=feature_files)
    # Worker processes run the tasks. The figures arrive in the order of the tasks.
    figures_of_tasks = ordered_map(train, tasks.values(), args.workers, timeout_s=None)
    for (name, seed), task_figures in zip(tasks, figures_of_tasks, strict=True):
        figures[name, seed] = task_figures
        write_text(args.out / f"{name}-{seed}.json", json.dumps(task_figures, indent=1))
        print(f"{name}, seed {seed}: {', '.join(cells(task_figures))}", flush=True)
    rows = []
    for (name, seed), task_figures in figures.items():
        rows.append([name, str(seed), *cells(task_figures)])
    header = ["head", "seed", "divider", "ped_crossing", "boundary", "mean"]
    print(f"\n{args.iterations} iterations of {args.batch}, AP_chamfer / AP_raster\n")
    print(markdown_table(header, rows))


def _option_values(args: argparse.Namespace, names: Sequence[str]) -> dict[str, str]:
    """Values of options as texts, by name."""
    values = {}
    for name in names:
        values[name] = str(getattr(args, name))
    return values


def record_settings(settings_of_file: Mapping[Path, dict[str, str]]) -> None:
    """Write the settings of features and figures to files, unless one of them has other settings.

    Args:
        settings_of_file: Values of the options that features or figures depend on, by JSON file.

    Raises:
        ValueError: If a file has other settings. No file is written then.
    """
    for path, settings in settings_of_file.items():
        if path.exists() and json.loads(path.read_text()) != settings:
            raise InputError(
                f"{path.parent} holds features or figures of other settings: give another --out."
            )
    for path, settings in settings_of_file.items():
        write_text(path, json.dumps(settings, indent=1))


def cells(figures: dict[str, float]) -> list[str]:
    """Format both APs of every class, then both means over the classes, in percent.

    Args:
        figures: Values by metric and class, such as ``chamfer/divider/AP``, and ``chamfer/mAP``.

    Returns:
        One text for each class and one for the mean, such as ``60.1 / 55.3`` (Chamfer / raster);
        ``-`` stands for a figure that does not exist.
    """
    keys = [f"{name}/AP" for name in CLASSES]
    keys.append("mAP")
    texts = []
    for key in keys:
        percentages = []
        for metric in METRIC_NAMES:
            value = figures[f"{metric}/{key}"]
            percentages.append("-" if value == UNDEFINED else f"{100 * value:.1f}")
        texts.append(" / ".join(percentages))
    return texts


@torch.no_grad()
def store_features(cfg: Config, checkpoint: str, part: str, path: Path) -> None:
    """Save the BEV features of the N samples of a split in float16 (N, C, H, W), and the samples.

    Args:
        cfg: Config of backbone, encoder and data.
        checkpoint: Checkpoint of the config, or name of a model.
        part: Split, ``train`` or ``val``.
        path: File to write.
    """
    with building(cfg):  # adds the name of the config to errors
        model = MODELS.build(cfg.model).eval()
    load_weights(model, checkpoint)
    dataset = DATASETS.build(cfg[f"{part}_dataloader"].dataset)
    feats = []
    samples = []
    for index in range(len(dataset)):
        batch = model.data_preprocessor(pseudo_collate([dataset[index]]))  # one sample
        bev = model.extract_feat(batch["inputs"], batch["data_samples"])["bev_feats"]
        feats.append(bev[0].half())
        samples += batch["data_samples"]
        if index % 100 == 0:
            print(f"features of {part}: {index} of {len(dataset)}", flush=True)
    data = {"feats": torch.stack(feats), "samples": samples, "metainfo": dataset.metainfo}
    with atomic_write(path, "wb") as file:
        torch.save(data, file)


def train_and_test(
    task: Task, args: argparse.Namespace, features: dict[str, Path]
) -> dict[str, float]:
    """Train one head on the stored features and test it.

    Args:
        task: Config of the head, seed and result file.
        args: Parsed options of ``add_arguments``.
        features: Files of ``store_features`` by split.

    Returns:
        Values of both metrics by key, such as ``chamfer/mAP``.
    """
    torch.set_num_threads(1)  # several tasks may run in parallel
    torch.manual_seed(task.seed)
    cfg = read_config(task.config, task.options)
    with building(cfg):  # adds the name of the config to errors
        model = MODELS.build(cfg.model)
    model.init_weights()
    if not args.from_scratch:
        load_weights(model, args.checkpoint)
    head = model.map_head.train()
    optim_cfg = cfg.optim_wrapper
    optimizer = torch.optim.AdamW(
        head.parameters(), lr=args.lr, weight_decay=optim_cfg.optimizer.weight_decay, fused=True
    )
    warm_up = LinearLR(optimizer, start_factor=0.1, total_iters=WARM_UP)
    decay = CosineAnnealingLR(
        optimizer, T_max=max(1, args.iterations - WARM_UP), eta_min=args.lr / 100
    )
    schedule = SequentialLR(optimizer, [warm_up, decay], milestones=[WARM_UP])
    # The file contains samples, not only tensors. With `mmap`, features are read when they are
    # used.
    train_data = torch.load(features["train"], weights_only=False, mmap=True)
    # A separate generator, so that the order of the batches does not depend on the head.
    generator = torch.Generator().manual_seed(task.seed)
    batches: list[torch.Tensor] = []
    for _ in range(args.iterations):
        if not batches:
            order = torch.randperm(len(train_data["samples"]), generator=generator)
            batches = list(order.split(args.batch))  # batches of the next epoch
        sample_inds = batches.pop()
        inputs = {"bev_feats": train_data["feats"][sample_inds].float()}
        samples = [train_data["samples"][index] for index in sample_inds.tolist()]
        losses = head.loss(inputs, samples)
        optimizer.zero_grad(set_to_none=True)
        total: Any = 0
        for name, value in losses.items():
            if "loss" in name:  # other entries are statistics
                total = total + value
        total.backward()
        torch.nn.utils.clip_grad_norm_(head.parameters(), optim_cfg.clip_grad.max_norm)
        optimizer.step()
        schedule.step()
    val_data = torch.load(features["val"], weights_only=False, mmap=True)
    return test(model, val_data, results=task.results)


@torch.no_grad()
def test(model: Any, data: dict[str, Any], results: Path) -> dict[str, float]:
    """Test a head on stored features and write its predictions.

    Args:
        model: Model with the head.
        data: Features ``feats`` (N, C, H, W), ``samples`` and ``metainfo`` of the split.
        results: Result file to write.

    Returns:
        Values of both metrics by key, such as ``chamfer/mAP``.
    """
    # The metric writes a table of level INFO to the logger that was created last. This logger drops
    # it.
    MMLogger.get_instance("heads", log_level="ERROR")
    model.eval()
    metric = METRICS.build({"type": "MapMetric", "eval": METRIC_NAMES, "out_file": str(results)})
    metric.dataset_meta = data["metainfo"]
    for feats, sample in zip(data["feats"], data["samples"], strict=True):
        predictions = model.map_head.predict({"bev_feats": feats[None].float()}, [sample])
        model.add_pred_to_datasample([sample], predictions)
        metric.process(None, [sample.to_dict()])
    return metric.evaluate(len(data["samples"]))
