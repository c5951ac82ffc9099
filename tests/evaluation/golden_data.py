"""Reads the reference inputs as the evaluator takes them."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.evaluation.chamfer_ap import ChamferConfig
from gsmap.evaluation.evaluator import MapEvaluator
from gsmap.evaluation.raster_ap import RasterConfig
from gsmap.evaluation.raster_drawing import Masks
from gsmap.structures.elements import MapElements

CLASSES = ("divider", "ped_crossing", "boundary")
EVALUATOR = MapEvaluator(ChamferConfig(CLASSES), RasterConfig(CLASSES))
Frame = tuple[str, MapElements, MapElements]


def read(path: Path) -> Any:
    return json.loads(path.read_text())


def frame_of(record: dict[str, Any]) -> Frame:
    pred, gt = record["pred"], record["gt"]
    predictions = MapElements.from_polylines(
        [p["pts"] for p in pred], [p["label"] for p in pred], [p["score"] for p in pred]
    )
    return (
        record["token"],
        predictions,
        MapElements.from_polylines([g["pts"] for g in gt], [g["label"] for g in gt]),
    )


def full_mask(masks: Masks, index: int, height: int, width: int) -> np.ndarray:
    """Unpack one mask to the whole canvas. (H, W)"""
    top, left, rows, words = masks.boxes[index]
    packed = masks.words[masks.starts[index] : masks.starts[index + 1]].astype("<u8")
    bits = np.unpackbits(packed.view(np.uint8), bitorder="little").reshape(rows, 64 * words)
    canvas = np.zeros((height, width), dtype=np.bool_)
    columns = min(64 * int(words), width - 64 * int(left))
    canvas[top : top + rows, 64 * left : 64 * left + columns] = bits[:, :columns]
    return canvas
