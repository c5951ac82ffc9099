"""What checks of releases with one-to-many queries share: their groups, and how these match."""

from collections.abc import Iterator, Mapping

import numpy as np
from mmengine.structures import InstanceData
from predictions import triples

from gsmap.models.base.head import MapHead
from gsmap.models.base.pairs import Predictions
from reference.report import Row

GROUPS = {"o2o": 20, "o2m": 60}  # the file's names and their queries
REPEATS = 3


def match_rows(
    name: str,
    data: Mapping[str, np.ndarray],
    head: MapHead,
    outputs: list[Predictions],
    gts: list[InstanceData],
) -> Iterator[Row]:
    """Compare the matches of both groups; copies of one ground truth stand for each other."""
    prepared = head.prepare_gts(gts)
    for label, (group, own) in zip(GROUPS, head.split_groups(outputs), strict=True):
        wrong = 0
        pairs = head.match(own, prepared, [{}] * len(gts), group.repeats)
        for layer, matches in enumerate(triples(pairs)):
            for sample, match in enumerate(matches):
                listed = data[f"match_{label}_l{layer}_b{sample}"]
                wrong += len(set(map(tuple, match.tolist())) ^ set(map(tuple, listed.tolist())))
        yield Row(name, f"{label}: matches that differ", wrong, 0)
