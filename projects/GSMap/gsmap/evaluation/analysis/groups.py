"""AP of parts of the samples: each town, each scene, or the scenes at night and in rain."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.evaluation.analysis.bootstrap import resampled_figures
from gsmap.evaluation.core.report import UNDEFINED, MetricReport
from gsmap.structures.elements import FloatArray, IntArray
from gsmap.utils.errors import InputError
from gsmap.utils.files import read_json

CONDITIONS = ("clear", "cloudy", "dusk", "night", "rain")
"""Words that are looked for in the descriptions of nuScenes' scenes, and MiniCity's."""
OTHERWISE = "day"  # nuScenes says neither that it is day nor that it is dry
_COLUMNS = {"scene": "scene", "map": "map_name"}
_LONGEST = 80  # characters of a group's name


@dataclass(frozen=True)
class Groups:
    """Parts of the samples.

    Args:
        group_of: Group of each sample, by token.
    """

    group_of: Mapping[str, str]

    @cached_property
    def names(self) -> list[str]:
        """The groups, sorted."""
        return sorted(set(self.group_of.values()))

    def draw(self, tokens: Sequence[str]) -> tuple[IntArray, FloatArray]:
        """Return the group of each sample (S,), and each group alone, as a resample. (G, G)"""
        if missing := next((token for token in tokens if token not in self.group_of), None):
            raise InputError(f"the group of sample {missing!r} is not known.")
        numbers = {name: number for number, name in enumerate(self.names)}
        found = np.array([numbers[self.group_of[token]] for token in tokens], dtype=np.int64)
        return found, np.eye(len(self.names))


def read_groups(annotations: str | Path, by: str) -> Groups:
    """Read what group each sample of an annotation file belongs to.

    Args:
        annotations: The annotation file.
        by: ``scene``, ``map``, or a JSON file with the group of each scene or of each sample; or
            the ``scene.json`` of nuScenes' tables, whose descriptions name weather and night.

    Raises:
        FileNotFoundError: If a file does not exist.
        ValueError: If there are no groups in it, or a scene or sample is not in the JSON file.
    """
    if Path(annotations).suffix.lower() == ".json":
        raise InputError(f"{annotations} knows no scenes: give the annotation file (.arrow).")
    if by not in _COLUMNS and not Path(by).is_file():
        raise FileNotFoundError(
            f"--by takes {', '.join(_COLUMNS)} or a JSON file, and there is no file {by!r}."
        )
    file = AnnotationFile(annotations)
    tokens = file.column("token")
    groups = file.column(_COLUMNS.get(by, "scene"))
    if by not in _COLUMNS:
        group_of = _groups_in(by)
        of_samples = not group_of.keys().isdisjoint(tokens)
        kind, names = ("sample", tokens) if of_samples else ("scene", groups)
        if missing := next((name for name in names if name not in group_of), None):
            raise InputError(f"{by} has no {kind} {missing!r}, which {annotations} has.")
        groups = [group_of[name] for name in names]
    return Groups(dict(zip(tokens, groups, strict=True)))


def _groups_in(path: str) -> dict[str, str]:
    """Read the group of each scene or sample."""
    content = read_json(path)
    if isinstance(content, list) and all(isinstance(row, dict) for row in content):
        content = {row.get("name"): _conditions(row.get("description")) for row in content}
    if not isinstance(content, dict) or not all(
        isinstance(text, str) and 0 < len(text) <= _LONGEST and text.isprintable()
        for text in content.values()
    ):
        raise InputError(
            f"{path} is neither an object with the group of each scene or sample, in at most "
            f"{_LONGEST} characters, nor a scene.json of nuScenes."
        )
    return content


def _conditions(description: object) -> str:
    """Return the words of a description that say what weather and light there are."""
    words = set(re.findall("[a-z]+", str(description).lower()))
    return ", ".join(word for word in CONDITIONS if word in words) or OTHERWISE


def ap_by_group(reports: Sequence[MetricReport], groups: Groups) -> dict[str, dict[str, float]]:
    """Return every AP of the samples of each group alone, by its flat key; -1 where there is none.

    No line is compared again: the AP of a group is that of a file with its samples.
    """
    found: dict[str, dict[str, float]] = {name: {} for name in groups.names}
    for report in reports:
        for key, values in resampled_figures(report, groups).items():
            for name, value in zip(groups.names, values, strict=True):
                found[name][key] = UNDEFINED if np.isnan(value) else float(value)
    return found


def group_report(found: Mapping[str, Mapping[str, float]]) -> MetricReport:
    """Return what `ap_by_group` does as one report, with keys such as ``by/night/chamfer/mAP``."""
    return MetricReport(
        "by",
        {},
        {f"by/{name}/{key}": v for name, aps in found.items() for key, v in aps.items()},
        {},
    )


def group_table(
    reports: Sequence[MetricReport], groups: Groups, found: Mapping[str, Mapping[str, float]]
) -> tuple[list[str], list[list[str]]]:
    """Return head and rows of a table: samples, means and classes of each group, in percent.

    Args:
        reports: Of all samples.
        groups: Their groups.
        found: From `ap_by_group`.
    """
    ranked = [report for report in reports if report.detections]
    parts = [(r.name, part) for r in ranked for part in ("mAP", *(f"{n}/AP" for n in r.detections))]
    numbers = np.bincount(groups.draw(reports[0].tokens)[0], minlength=len(groups.names))
    rows = []
    for (name, figures), number in zip(found.items(), numbers, strict=True):
        values = (figures[f"{metric}/{part}"] for metric, part in parts)
        cells = ("-" if value == UNDEFINED else f"{100 * value:.1f}" for value in values)
        rows.append([name, str(number), *cells])
    return ["", "samples", *(f"{m} {part.removesuffix('/AP')}" for m, part in parts)], rows
