"""Reads the reference inputs as the evaluator takes them."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.evaluation.core.chamfer_ap import ChamferConfig
from gsmap.evaluation.core.evaluator import MapEvaluator
from gsmap.evaluation.core.raster_ap import RasterConfig
from gsmap.structures.elements import MapElements

CLASSES = ("divider", "ped_crossing", "boundary")
EVALUATOR = MapEvaluator(ChamferConfig(CLASSES), RasterConfig(CLASSES))
Frame = tuple[str, MapElements, MapElements]


def read(path: Path) -> Any:
    return json.loads(path.read_text())


def frame_of(record: dict[str, Any]) -> Frame:
    pred, gt = record["pred"], record["gt"]
    labels = [
        [-1 if e["label"] >= len(CLASSES) else e["label"] for e in part] for part in (pred, gt)
    ]
    scores = [p["score"] for p in pred]
    return (
        record["token"],
        MapElements.from_polylines([p["pts"] for p in pred], labels[0], scores),
        MapElements.from_polylines([g["pts"] for g in gt], labels[1]),
    )


def unpacked(masks: np.ndarray, width: int) -> np.ndarray:
    """Unpack masks of 64 columns to a word. (N, H, words) -> (N, H, W)"""
    bits = np.unpackbits(masks.astype("<u8").view(np.uint8), axis=-1, bitorder="little")
    return bits[..., :width].astype(bool)
