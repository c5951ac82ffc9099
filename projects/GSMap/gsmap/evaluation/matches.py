"""What the metrics keep of one sample: scores and matches, never masks or points."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.structures.elements import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class FrameMatches:
    """The matches of one sample's predictions.

    Rows are the predictions that count, in descending order of score (equal scores in the order
    in which they were given).

    Args:
        token: Name of the sample.
        pred_index: Position among the predictions that were given. (N,)
        labels: Class index. (N,)
        scores: Confidence. (N,)
        matched_gt: Position of the matched ground truth among those given, or -1. (N, T)
        quality: Chamfer distance in metres of the match (NaN without one at any threshold), or IoU
            of the match at the loosest threshold (NaN without one). (N,)
        num_gts: Number of ground truths of each class. (C,)
        areas: Pixels in the intersection and in the union of all predictions and all ground truths
            of each class; only AP_raster fills it. (C, 2)
    """

    token: str
    pred_index: IntArray
    labels: IntArray
    scores: FloatArray
    matched_gt: IntArray
    quality: FloatArray
    num_gts: IntArray
    areas: IntArray | None = None


@dataclass(frozen=True)
class MatchTable:
    """The matches of many samples as columns: what processes hand over and reports read.

    Args:
        tokens: Names of the samples. (S,)
        counts: Number of predictions of each sample. (S,)
        labels: Class index of the predictions of all samples, one sample after another. (N,)
        scores: Confidence. (N,)
        hits: Whether the prediction matches, at each threshold. (N, T)
        quality: As in ``FrameMatches``. (N,)
        num_gts: Number of ground truths of each class. (S, C)
        areas: As in ``FrameMatches``. (S, C, 2)
    """

    tokens: list[str]
    counts: IntArray
    labels: IntArray
    scores: FloatArray
    hits: BoolArray
    quality: FloatArray
    num_gts: IntArray
    areas: IntArray | None = None

    def __len__(self) -> int:
        return len(self.tokens)

    @property
    def sample(self) -> IntArray:
        """Position of each prediction's sample. (N,)"""
        return np.repeat(np.arange(len(self)), self.counts)

    def select(self, samples: IntArray) -> "MatchTable":
        """Return some of the samples, in the order that is asked for.

        Args:
            samples: Their positions. (K,)
        """
        counts = self.counts[samples]
        starts = (np.cumsum(self.counts) - self.counts)[samples]
        rows = np.arange(counts.sum()) + np.repeat(starts - np.cumsum(counts) + counts, counts)
        return MatchTable(
            [self.tokens[i] for i in samples.tolist()],
            counts,
            self.labels[rows],
            self.scores[rows],
            self.hits[rows],
            self.quality[rows],
            self.num_gts[samples],
            None if self.areas is None else self.areas[samples],
        )


def join_tables(tables: Sequence[MatchTable]) -> MatchTable:
    """Put tables of the same metric one after another.

    Args:
        tables: Tables; those without samples are passed over.
    """
    tables = [t for t in tables if len(t)]
    if not tables:
        return as_table([])
    areas = [t.areas for t in tables if t.areas is not None]
    return MatchTable(
        [token for t in tables for token in t.tokens],
        np.concatenate([t.counts for t in tables]),
        np.concatenate([t.labels for t in tables]),
        np.concatenate([t.scores for t in tables]),
        np.concatenate([t.hits for t in tables]),
        np.concatenate([t.quality for t in tables]),
        np.concatenate([t.num_gts for t in tables]),
        np.concatenate(areas) if areas else None,
    )


def as_table(matches: MatchTable | Iterable[FrameMatches]) -> MatchTable:
    """Return matches as a table.

    Args:
        matches: A table, or one record per sample.
    """
    if isinstance(matches, MatchTable):
        return matches
    records = list(matches)
    if not records:
        none = np.zeros(0, dtype=np.int64)
        flags = np.zeros((0, 0), dtype=np.bool_)
        return MatchTable([], none, none, np.zeros(0), flags, np.zeros(0), none.reshape(0, 0))
    areas = [m.areas for m in records if m.areas is not None]
    return MatchTable(
        [m.token for m in records],
        np.array([len(m.labels) for m in records], dtype=np.int64),
        np.concatenate([m.labels for m in records]),
        np.concatenate([m.scores for m in records]),
        np.concatenate([m.matched_gt for m in records]) >= 0,
        np.concatenate([m.quality for m in records]),
        np.stack([m.num_gts for m in records]),
        np.stack(areas) if areas else None,
    )


def unique_by_token(table: MatchTable) -> MatchTable:
    """Return one sample per token, in the order of the tokens.

    Samples that a sampler repeated to fill the last batch are counted once, and no figure depends
    on the order of the samples or on the process that saw them.

    Args:
        table: Samples in any order.
    """
    first: dict[str, int] = {}
    for position, token in enumerate(table.tokens):
        first.setdefault(token, position)
    return table.select(np.array([first[token] for token in sorted(first)], dtype=np.int64))


@dataclass(frozen=True)
class ClassDetections:
    """The predictions of one class over all samples, in descending order of score.

    Args:
        scores: Confidence. (N,)
        hits: Whether the prediction matches, at each threshold. (N, T)
        quality: As in ``FrameMatches``. (N,)
        ranks: Rank of the prediction among those of its class and sample, from 0. (N,)
        num_gts: Number of ground truths.
    """

    scores: FloatArray
    hits: BoolArray
    quality: FloatArray
    ranks: IntArray
    num_gts: int


def _ranks_within_frames(frame: IntArray) -> IntArray:
    """Count up from 0 within each run of equal entries. (N,)"""
    if not len(frame):
        return np.zeros(0, dtype=np.int64)
    starts = np.flatnonzero(np.diff(frame, prepend=frame[0] - 1))
    lengths = np.diff(starts, append=len(frame))
    return np.arange(len(frame)) - np.repeat(starts, lengths)


def detections_per_class(
    table: MatchTable, num_classes: int, num_thresholds: int
) -> list[ClassDetections]:
    """Gather the predictions of each class over all samples and rank them by score.

    Equal scores keep the order of the samples, then the order within the sample: the reference
    evaluators leave their order to an unstable sort (AP_chamfer) or to the order of the file
    (AP_raster).

    Args:
        table: The samples, from ``unique_by_token``.
        num_classes: Number of classes C.
        num_thresholds: Number of thresholds T.

    Returns:
        One entry per class. (C,)
    """
    if not len(table):
        none = ClassDetections(
            np.zeros(0),
            np.zeros((0, num_thresholds), dtype=np.bool_),
            np.zeros(0),
            np.zeros(0, dtype=np.int64),
            0,
        )
        return [none] * num_classes
    frame = table.sample
    num_gts = table.num_gts.sum(axis=0)
    detections = []
    for c in range(num_classes):
        rows = np.flatnonzero(table.labels == c)
        ranks = _ranks_within_frames(frame[rows])
        order = np.argsort(-table.scores[rows], kind="stable")
        rows = rows[order]
        detections.append(
            ClassDetections(
                table.scores[rows],
                table.hits[rows],
                table.quality[rows],
                ranks[order],
                int(num_gts[c]),
            )
        )
    return detections
