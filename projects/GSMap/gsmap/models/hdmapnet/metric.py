"""HDMapNet's metric: AP per sample of lines that are drawn with a thickness of five pixels."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from gsmap.evaluation.core.metric import register_metric
from gsmap.evaluation.core.sample_ap import SampleAP


@register_metric
@dataclass(frozen=True)
class HDMapNetAP(SampleAP):
    """AP per sample with the rules of HDMapNet's released evaluator."""

    name: ClassVar[str] = "hdmapnet"
    line_px: ClassVar[int] = 5
    # Largest distances of a match in metres, by the name of the report.
    report_thresholds: ClassVar[Mapping[str, tuple[float, ...]]] = {"hdmapnet": (2.0, 4.0, 6.0)}
