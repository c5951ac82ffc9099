#!/usr/bin/env python
"""Write a result file with Bezier curves in place of points, within an error in metres.

All commands of the project read the new file like the original. To write it and to evaluate it:
    python tools/compact_results.py results.json compact.json --max-error 0.1
    python tools/evaluate.py compact.json gsmap_nuscenes_val.arrow
"""

import argparse
from pathlib import Path

from gsmap.evaluation.analysis.compact import compact_results
from gsmap.utils.cli import CommandParser, output_file, run_command
from gsmap.utils.words import format_count


def main(argv: list[str] | None = None) -> str:
    """Write the compact result file, and return the report that `run_command` prints.

    Args:
        argv: Arguments of the command; None for the arguments of this process.
    """
    # The module's docstring is also the help text.
    parser = CommandParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("results", type=Path, help="results in MapTR's JSON form")
    parser.add_argument("out", type=output_file, help="file to write")
    parser.add_argument("--degree", type=int, default=3, help="degree of the curves, 1 to 5")
    parser.add_argument("--max-error", type=float, default=0.1, help="largest error in metres")
    args = parser.parse_args(argv)
    # Numbers of replaced elements, of their points and of the control points of the curves, and the
    # largest error in metres
    summary = compact_results(args.results, args.out, args.degree, args.max_error)
    old_mb = args.results.stat().st_size / 1e6
    new_mb = args.out.stat().st_size / 1e6
    return (
        f"{format_count(summary.elements, 'element')}, {summary.vertices} points as "
        f"{summary.controls} control points, at most {summary.largest_m:.3f} m off: {args.out} "
        f"({new_mb:.1f} MB instead of {old_mb:.1f})"
    )


if __name__ == "__main__":
    run_command(main)
