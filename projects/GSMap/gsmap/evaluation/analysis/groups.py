"""AP of groups of samples: by town, by scene, or by weather and time of day."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from gsmap.datasets.annotations.file import AnnotationFile
from gsmap.evaluation.analysis import CHANGES_SUFFIX
from gsmap.evaluation.analysis.bootstrap import resampled_figures
from gsmap.evaluation.analysis.change_files import read_changes
from gsmap.evaluation.analysis.changes import changed_samples
from gsmap.evaluation.core.report import UNDEFINED, MetricReport
from gsmap.structures.elements import FloatArray, IntArray
from gsmap.utils.errors import InputError
from gsmap.utils.files import read_json

CONDITIONS = ("clear", "cloudy", "dusk", "night", "rain")
"""Words for weather and light in the descriptions of scenes, in nuScenes and MiniCity."""
OTHERWISE = "day"  # group of a scene without such a word; nuScenes has no word for a dry day
# Column of the annotation file that contains the group, by the value of ``by`` in `read_groups`.
_COLUMNS = {"scene": "scene", "map": "map_name"}
_LONGEST = 80  # characters of the name of a group


@dataclass(frozen=True)
class Groups:
    """Groups of the samples.

    Args:
        group_of: Group of each sample, by token.
    """

    group_of: Mapping[str, str]

    @cached_property
    def names(self) -> list[str]:
        """Names of the groups, sorted. (G,)"""
        return sorted(set(self.group_of.values()))

    def draw_copies(self, tokens: Sequence[str]) -> tuple[IntArray, FloatArray]:
        """Return one resample per group, with each sample of the group once and no other sample.

        Thus, the AP in a resample (`bootstrap.resampled_figures`) is the AP of a group. The name of
        the method comes from the interface `bootstrap.Weights`, which it implements. Nothing is
        drawn at random.

        Args:
            tokens: Tokens of the samples. (S,)

        Returns:
            Index of the group of each sample, (S,), and the number of copies of each group
            (columns) in each resample (rows), which is the identity matrix, (G, G).

        Raises:
            ValueError: If the group of a sample is unknown.
        """
        index_of = {name: index for index, name in enumerate(self.names)}
        indices = []
        for token in tokens:
            if token not in self.group_of:
                raise InputError(f"the group of sample {token!r} is not known.")
            indices.append(index_of[self.group_of[token]])
        return np.array(indices, dtype=np.int64), np.eye(len(self.names))


def read_groups(annotations: str | Path, by: str) -> Groups:
    """Read the group of each sample of an annotation file.

    Args:
        annotations: Path of the annotation file.
        by: ``scene``, ``map``, or a JSON file with the group of each scene or of each sample. With
            the ``scene.json`` of nuScenes, samples are grouped by the words for weather and light
            in its descriptions. With a GeoJSON file of changes, samples are grouped by whether a
            change lies in their range.

    Raises:
        FileNotFoundError: If a file does not exist.
        ValueError: If a file contains no groups, or the JSON file lacks a scene or sample.
    """
    if Path(annotations).suffix.lower() == ".json":
        raise InputError(f"{annotations} knows no scenes: give the annotation file (.arrow).")
    if by not in _COLUMNS and not Path(by).is_file():
        raise FileNotFoundError(
            f"--by takes {', '.join(_COLUMNS)}, distance or a file, and there is no file {by!r}."
        )
    file = AnnotationFile(annotations)
    if Path(by).suffix.lower() == CHANGES_SUFFIX:
        # The groups are "changed" and "unchanged".
        return Groups(changed_samples(read_changes(by), file))
    tokens = file.column("token")
    if by in _COLUMNS:
        groups = file.column(_COLUMNS[by])
        return Groups(dict(zip(tokens, groups, strict=True)))
    # The keys of the file are names of scenes if none of them is the token of a sample.
    group_of = _read_group_file(by)
    if group_of.keys().isdisjoint(tokens):
        kind = "scene"
        names = file.column("scene")
    else:
        kind = "sample"
        names = tokens
    for name in names:
        if name not in group_of:
            raise InputError(f"{by} has no {kind} {name!r}, which {annotations} has.")
    groups = [group_of[name] for name in names]
    return Groups(dict(zip(tokens, groups, strict=True)))


def _read_group_file(path: str) -> dict[str, str]:
    """Read the group of each scene or sample from a JSON file."""
    content = read_json(path)
    is_scene_table = isinstance(content, list) and all(isinstance(row, dict) for row in content)
    if is_scene_table:  # scene.json of nuScenes
        scenes = {}
        for row in content:
            scenes[row.get("name")] = _conditions(row.get("description"))
        content = scenes
    if not isinstance(content, dict) or not all(map(_is_group_name, content.values())):
        raise InputError(
            f"{path} is neither an object with the group of each scene or sample, in at most "
            f"{_LONGEST} characters, nor a scene.json of nuScenes."
        )
    return content


def _is_group_name(value: object) -> bool:
    """Whether a value is a printable text of at most 80 characters, and not empty."""
    return isinstance(value, str) and 0 < len(value) <= _LONGEST and value.isprintable()


def _conditions(description: object) -> str:
    """Return the words for weather and light in a description, joined by commas."""
    words = set(re.findall("[a-z]+", str(description).lower()))
    return ", ".join(word for word in CONDITIONS if word in words) or OTHERWISE


def ap_by_group(reports: Sequence[MetricReport], groups: Groups) -> dict[str, dict[str, float]]:
    """Compute every AP over the samples of each group alone.

    The AP of a group equals the AP of an evaluation of its samples alone. Predictions are not
    matched again, because the reports contain the matches.

    Args:
        reports: Reports of all metrics over all samples.
        groups: Groups of the samples.

    Returns:
        AP in [0, 1] by name of the group and flat key, such as ``chamfer/mAP``; -1 where it is
        undefined.
    """
    group_aps: dict[str, dict[str, float]] = {}
    for name in groups.names:
        group_aps[name] = {}
    for report in reports:
        # Each key has one AP per group, in the order of `groups.names`.
        for key, aps in resampled_figures(report, groups).items():
            for name, value in zip(groups.names, aps, strict=True):
                group_aps[name][key] = UNDEFINED if np.isnan(value) else float(value)
    return group_aps


def group_report(group_aps: Mapping[str, Mapping[str, float]]) -> MetricReport:
    """Convert the figures of `ap_by_group` to a report, with keys such as ``by/night/chamfer/mAP``.

    Args:
        group_aps: AP by name of the group and flat key.
    """
    metrics = {}
    for name, aps in group_aps.items():
        for key, value in aps.items():
            metrics[f"by/{name}/{key}"] = value
    # The report has figures only: no groups of classes and no ranked predictions.
    return MetricReport(name="by", groups={}, metrics=metrics, detections={})


def group_table(
    reports: Sequence[MetricReport], groups: Groups, group_aps: Mapping[str, Mapping[str, float]]
) -> tuple[list[str], list[list[str]]]:
    """Create a table with the number of samples and the AP of each group, in percent.

    Args:
        reports: Reports of all metrics over all samples.
        groups: Groups of the samples.
        group_aps: Figures of `ap_by_group`.

    Returns:
        Head and rows of the table. The columns are the name of the group, the number of samples,
        and for each metric the mAP and the AP of each class.
    """
    head = ["", "samples"]
    keys = []
    for report in reports:
        if report.detections:  # a metric that ranks no predictions has no AP
            head.append(f"{report.name} mAP")
            keys.append(f"{report.name}/mAP")
            for class_name in report.detections:
                head.append(f"{report.name} {class_name}")
                keys.append(f"{report.name}/{class_name}/AP")
    group_index, _ = groups.draw_copies(reports[0].tokens)
    num_samples = np.bincount(group_index, minlength=len(groups.names))
    rows = []
    # Both are in the order of `groups.names`.
    for (name, figures), count in zip(group_aps.items(), num_samples, strict=True):
        row = [name, str(count)]
        for key in keys:
            value = figures[key]
            row.append("-" if value == UNDEFINED else f"{100 * value:.1f}")
        rows.append(row)
    return head, rows
