"""Training settings of the release."""

from dataclasses import replace

from released_settings import EFFICIENT, LINES, UPERNET

RELEASED = {
    # wenjie710/PivotNet, configs
    "configs/pivotnet/pivotnet_r50_30e.py": LINES,
    "configs/pivotnet/pivotnet_swint_30e.py": replace(LINES, **UPERNET),
    "configs/pivotnet/pivotnet_effb0_30e.py": replace(LINES, **EFFICIENT),
}  # fmt: skip
