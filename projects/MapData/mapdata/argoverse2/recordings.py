"""Samples of Argoverse 2 logs, without maps or ground truth."""

from collections import Counter
from pathlib import Path

from gsmap.datasets.annotations.record import MapSample
from mapdata.argoverse2.log import POSES
from mapdata.argoverse2.samples import Argoverse2Options, read_log


def logs_in(folder: Path) -> list[Path]:
    """Return the logs at or up to three folders below a folder (``sensor/val/LOG``)."""
    found = (sorted(folder.glob("*/" * depth + POSES)) for depth in range(4))
    return [path.parent for path in next(filter(None, found), [])]


def read_logs(
    log_dirs: list[Path], root: Path, rate_hz: float | None = 2.0
) -> tuple[list[MapSample], Counter[str]]:
    """Read the samples of logs, in the frame ``ego``.

    Args:
        log_dirs: The logs' folders.
        root: Folder that paths are relative to.
        rate_hz: Samples per second; None takes every sweep's or image's time.

    Returns:
        The samples, and how many were left out, by reason.

    Raises:
        ValueError: If no log has a sample; the message says why.
    """
    options = Argoverse2Options(root, rate_hz=rate_hz)
    samples, left_out = [], Counter[str]()
    for log_dir in log_dirs:
        try:
            result = read_log(log_dir, options, with_map=False)
        except (OSError, ValueError) as error:
            left_out[f"{log_dir.name}: {error}"] += 1
            continue
        samples += result.samples
        left_out.update({f"{log_dir.name}: {why}": n for why, n in result.left_out.items()})
    if not samples:
        raise ValueError(f"no sample can be read from {root}: {'; '.join(left_out) or 'no log'}.")
    return samples, left_out
