"""Reads the reference inputs as the evaluator takes them."""

import json
from pathlib import Path
from typing import Any

from gsmap.evaluation.chamfer_ap import ChamferConfig
from gsmap.evaluation.evaluator import EvaluationConfig
from gsmap.evaluation.raster_ap import RasterConfig
from gsmap.structures.elements import MapElements

CLASSES = ("divider", "ped_crossing", "boundary")
CONFIG = EvaluationConfig(ChamferConfig(CLASSES), RasterConfig(CLASSES))
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


def vectors_of(elements: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Convert the golden form of elements to MapTR's."""
    return [
        {
            "pts": e["pts"],
            "pts_num": len(e["pts"]),
            "cls_name": CLASSES[e["label"]],
            "type": e["label"],
            **({"confidence_level": e["score"]} if "score" in e else {}),
        }
        for e in elements
    ]
