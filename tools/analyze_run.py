#!/usr/bin/env python
"""Draw the loss and metric curves of training runs and print a table of them.

Example: ``python tools/analyze_run.py work_dirs/maptr work_dirs/gsmap --out curves.png``.
``--keys soft_iou/divider at_floor`` draws these logged values instead, one panel each.
"""

# Imported before all libraries: this handles Ctrl-C during their imports, and keeps them from
# reading settings files in the working folder.
import gsmap  # noqa: F401

# isort: split
import argparse
from pathlib import Path

from comparison.run_curves import plot_runs, plot_series, read_run, summary_table

from gsmap.utils.cli import CommandParser, output_file, run_command
from gsmap.utils.errors import InputError
from gsmap.utils.files import write_text
from gsmap.utils.words import format_count
from gsmap.visualization.figure import save_figure


def parse_args() -> argparse.Namespace:
    # `output_file` returns a path, after a check that the file can be written.
    parser = CommandParser(description=__doc__)
    parser.add_argument(
        "runs", nargs="+", type=Path, help="work folders of runs, or scalars.json files"
    )
    parser.add_argument("--names", nargs="+", help="a name for each run, for the legend")
    parser.add_argument(
        "--out", type=output_file, help="picture to write: .png, .jpg, .pdf or .svg"
    )
    parser.add_argument("--keys", nargs="+", help="logged values to draw instead of the losses")
    parser.add_argument(
        "--table", type=output_file, help="also write the Markdown table to this file"
    )
    args = parser.parse_args()
    if args.keys and not args.out:
        parser.error("--keys draws a picture: give --out, too")
    return args


def main() -> None:
    args = parse_args()
    names = args.names or [None] * len(args.runs)  # None selects the name of the folder of a run
    if len(names) != len(args.runs):
        raise InputError(f"--names gives {len(names)} names for {len(args.runs)} runs.")
    runs = [read_run(path, name) for path, name in zip(args.runs, names, strict=True)]
    table = summary_table(runs)  # Markdown text
    print(table)  # before anything is written: a disk may be full
    for run in runs:
        if run.num_replaced:
            trainings = format_count(run.num_replaced, "earlier training")
            print(f"not shown: {trainings} in the folder of {run.name}")
    if args.table:
        write_text(args.table, table + "\n")
    if args.out:
        # `plot_series` draws the values of --keys. `plot_runs` draws losses and validation metrics.
        figure = plot_series(runs, args.keys) if args.keys else plot_runs(runs)
        print(f"curves: {save_figure(figure, args.out)}")


if __name__ == "__main__":
    run_command(main)
