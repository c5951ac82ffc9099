"""BeMapNet's metric: AP per sample of lines drawn one pixel wide, at two sets of thresholds."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from gsmap.evaluation.core.metric import register_metric
from gsmap.evaluation.core.sample_ap import SampleAP


@register_metric
@dataclass(frozen=True)
class BeMapNetAP(SampleAP):
    """AP per sample with the rules of BeMapNet's released evaluator."""

    name: ClassVar[str] = "bemapnet"
    line_px: ClassVar[int] = 1
    # Largest distances of a match in metres, by the name of the report.
    report_thresholds: ClassVar[Mapping[str, tuple[float, ...]]] = {
        "bemapnet": (0.5, 1.0, 1.5),
        "bemapnet_hard": (0.2, 0.5, 1.0),
    }
