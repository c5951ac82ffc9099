"""Ablate the map head alone, on stored BEV features of a common checkpoint, in paired runs.

Backbone, neck and BEV encoder are frozen and run once (the pipeline must not augment), so a run
costs a fraction of fine-tuning the whole model. Every variant starts from the head of the
checkpoint (or, with ``--from-scratch``, from a new one), sees the same batches in the same order,
and is tested on the same features. Its predictions, ``NAME-SEED/results.json``, are for ``shape``.
"""

import argparse
import json
import shlex
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from mmdet3d.registry import DATASETS, METRICS, MODELS
from mmengine.config import Config
from mmengine.dataset import pseudo_collate
from mmengine.logging import MMLogger

from benchmarks.measure import markdown_table
from gsmap.checkpoints.building import building
from gsmap.checkpoints.reading import load_weights
from gsmap.datasets.annotations.record import CLASSES
from gsmap.engine.arguments import data_root_options, parse_options
from gsmap.engine.launch import read_config
from gsmap.utils.errors import InputError
from gsmap.utils.files import atomic_write, write_text
from gsmap.utils.parallel import ordered_map

METRIC_NAMES = ("chamfer", "raster")
_DECIDING = ("config", "checkpoint", "data_root", "iterations", "batch", "lr", "from_scratch")


@dataclass(frozen=True)
class Task:
    """One run: a variant of a config's head, a seed, and where its predictions go."""

    config: Path
    options: dict[str, Any]
    seed: int
    results: Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("config", type=Path, help="config of backbone, encoder and data")
    parser.add_argument("checkpoint", help="of that config, or the name of a model")
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
        help="train new heads on the features, not trained ones",
    )
    parser.add_argument("--workers", type=int, default=1, help="runs at the same time")


def run(args: argparse.Namespace) -> None:
    """Store the features, train and test every variant, print a table."""
    variants: dict[str, str] = json.loads(args.variants.read_text())
    settings = {key: str(getattr(args, key)) for key in _DECIDING}
    for name, text in variants.items():
        refuse_others(args.out / f"{name}.settings.json", {**settings, "variant": text})
    options = data_root_options(args.data_root)
    features = {part: args.out / f"{part}.pt" for part in ("train", "val")}
    for part, path in features.items():
        if not path.exists():
            store_features(read_config(args.config, options), args.checkpoint, part, path)
    tasks = {}
    for name, text in variants.items():
        config, *overrides = shlex.split(text)
        changed = parse_options(overrides) if overrides else {}
        for seed in range(args.seeds):
            results = args.out / f"{name}-{seed}/results.json"
            tasks[name, seed] = Task(Path(config), changed, seed, results)
    figures: dict[tuple[str, int], dict[str, float]] = {}
    paths = {(name, seed): args.out / f"{name}-{seed}.json" for name, seed in tasks}
    done = [key for key, path in paths.items() if path.exists()]
    figures |= {key: json.loads(paths[key].read_text()) for key in done}
    waiting = [key for key in tasks if key not in figures]
    train = partial(train_and_test, args=args, features=features)
    work = ordered_map(train, map(tasks.__getitem__, waiting), args.workers, timeout_s=None)
    for key, found in zip(waiting, work, strict=True):
        figures[key] = found
        write_text(paths[key], json.dumps(found, indent=1))
        print(f"{key[0]}, seed {key[1]}: {', '.join(cells(found))}", flush=True)
    table = [[name, str(seed), *cells(found)] for (name, seed), found in figures.items()]
    header = ["head", "seed", "divider", "ped_crossing", "boundary", "mean"]
    print(f"\n{args.iterations} iterations of {args.batch}, AP_chamfer / AP_raster\n")
    print(markdown_table(header, table))


def refuse_others(path: Path, settings: dict[str, str]) -> None:
    """Note what a variant's figures come from, or raise an error if those there are of others."""
    if path.exists() and json.loads(path.read_text()) != settings:
        raise InputError(f"{path.parent} holds figures of other settings: give another --out.")
    write_text(path, json.dumps(settings, indent=1))


def cells(figures: dict[str, float]) -> list[str]:
    """Return both APs of every class and their mean, in percent."""
    keys = [f"{name}/AP" for name in CLASSES] + ["mAP"]
    return [" / ".join(f"{100 * figures[f'{m}/{key}']:.1f}" for m in METRIC_NAMES) for key in keys]


@torch.no_grad()
def store_features(cfg: Config, checkpoint: str, part: str, path: Path) -> None:
    """Save the BEV features (N, C, H, W), float16, and the samples of a split."""
    with building(cfg):
        model = MODELS.build(cfg.model).eval()
    load_weights(model, checkpoint)
    dataset = DATASETS.build(cfg[f"{part}_dataloader"].dataset)
    feats, samples = [], []
    for index in range(len(dataset)):
        batch = model.data_preprocessor(pseudo_collate([dataset[index]]))
        bev = model.extract_feat(batch["inputs"], batch["data_samples"])["bev_feats"]
        feats.append(bev[0].half())
        samples += batch["data_samples"]
        if index % 100 == 0:
            print(f"features of {part}: {index} of {len(dataset)}", flush=True)
    stored = {"feats": torch.stack(feats), "samples": samples, "metainfo": dataset.metainfo}
    with atomic_write(path, "wb") as file:
        torch.save(stored, file)


def train_and_test(
    task: Task, args: argparse.Namespace, features: dict[str, Path]
) -> dict[str, float]:
    """Train one head on the stored features and return its figures."""
    torch.set_num_threads(1)
    torch.manual_seed(task.seed)
    cfg = read_config(task.config, task.options)
    with building(cfg):
        model = MODELS.build(cfg.model)
    model.init_weights()
    if not args.from_scratch:
        load_weights(model, args.checkpoint)
    head = model.map_head.train()
    rates = cfg.optim_wrapper
    optimizer = torch.optim.AdamW(
        head.parameters(), args.lr, weight_decay=rates.optimizer.weight_decay, fused=True
    )
    schedule = torch.optim.lr_scheduler.SequentialLR(
        optimizer,
        [
            torch.optim.lr_scheduler.LinearLR(optimizer, 0.1, total_iters=100),
            torch.optim.lr_scheduler.CosineAnnealingLR(
                optimizer, max(1, args.iterations - 100), eta_min=args.lr / 100
            ),
        ],
        [100],
    )
    data = torch.load(features["train"], weights_only=False, mmap=True)
    order = torch.Generator().manual_seed(task.seed)
    batches: list[torch.Tensor] = []
    for _ in range(args.iterations):
        if not batches:
            batches = list(torch.randperm(len(data["samples"]), generator=order).split(args.batch))
        chosen = batches.pop()
        inputs = {"bev_feats": data["feats"][chosen].float()}
        losses = head.loss(inputs, [data["samples"][i] for i in chosen.tolist()])
        optimizer.zero_grad(set_to_none=True)
        sum(value for name, value in losses.items() if "loss" in name).backward()
        torch.nn.utils.clip_grad_norm_(head.parameters(), rates.clip_grad.max_norm)
        optimizer.step()
        schedule.step()
    data = torch.load(features["val"], weights_only=False, mmap=True)
    return test(model, data, task.results)


@torch.no_grad()
def test(model: Any, data: dict[str, Any], results: Path) -> dict[str, float]:
    """Write the predictions and return every figure of both metrics."""
    MMLogger.get_instance("heads", log_level="ERROR")
    model.eval()
    metric = METRICS.build({"type": "MapMetric", "eval": METRIC_NAMES, "out_file": str(results)})
    metric.dataset_meta = data["metainfo"]
    for feats, sample in zip(data["feats"], data["samples"], strict=True):
        found = model.map_head.predict({"bev_feats": feats[None].float()}, [sample])
        model.add_pred_to_datasample([sample], found)
        metric.process(None, [sample.to_dict()])
    return metric.evaluate(len(data["samples"]))
