#!/usr/bin/env python
r"""Train and test several configs on the same data, seeds and budget, and write a table.

``CONFIG`` is a file, the name of a model, or ``NAME=CONFIG[,KEY=VALUE...]``. Repeat a stopped
command to continue it; finished runs are not trained again. ``--list`` prints every row of the
papers' tables (``gsmap/models/<method>/paper.json``) with the command that trains it.

Examples:
    python tools/compare.py maptr_r18_minicity gsmap_r18_minicity --seeds 3 --budget 6400 --out s
    python tools/compare.py base=CONFIG light=CONFIG,model.map_head.loss_raster.loss_weight=5.0 \
        --init maptr_r18_minicity --seeds 2 --budget 1600 --out f
    python tools/compare.py --runs MapTR=work_dirs/a MapTR=work_dirs/b GSMap=work_dirs/c --out d
    python tools/compare.py --list --tables 'GSMap Table 5*'
"""

# Imported before all libraries: this handles Ctrl-C during their imports, and keeps them from
# reading settings files in the working folder.
import gsmap  # noqa: F401

# isort: split
import argparse
import shlex
import sys
from collections.abc import Iterable, Iterator, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from comparison.jobs import execute
from comparison.plan import Protocol, Run, parse_entry, plan
from comparison.results import apply_rescoring, check_one_test_set, read_result
from comparison.run_curves import plot_precision_recall
from comparison.tables import as_json, markdown, plot_iterations

from gsmap.engine.arguments import OverrideAction
from gsmap.methods import METHODS
from gsmap.utils.cli import CommandParser, EachOnce, run_command
from gsmap.utils.errors import InputError, WorkError
from gsmap.utils.files import read_json, write_text
from gsmap.utils.progress import Progress
from gsmap.utils.shipped import shipped_path
from gsmap.visualization.figure import save_figure


def parse_args() -> argparse.Namespace:
    parser = CommandParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("configs", nargs="*", metavar="CONFIG", help="configs, by file or name")
    parser.add_argument("--seeds", type=int, default=1, metavar="N", help="seeds 0 to N - 1")
    parser.add_argument("--budget", type=int, metavar="ITERATIONS", help="length of every run")
    parser.add_argument("--batch", type=int, default=4, help="samples per iteration")
    parser.add_argument("--out", type=Path, metavar="DIR", help="work folders, tables and plots")
    parser.add_argument(
        "--init", metavar="CHECKPOINT", help="checkpoint that all runs start from: file or name"
    )
    parser.add_argument(
        "--runs",
        nargs="+",
        action=EachOnce,
        default=[],
        metavar="NAME=DIR",
        help="work folders of finished runs, with metrics.json (tools/test.py --metrics-out), and "
        "results.json (--out) for precision-recall curves and --rescore",
    )
    parser.add_argument(
        "--rescore",
        nargs="+",
        action=OverrideAction,
        metavar="KEY=VALUE",
        help="score again with other settings, such as thresholds=[0.2,0.5,1.0]; trains nothing",
    )
    parser.add_argument("--only", metavar="NAME/seed_N", help="only this run, without tables")
    parser.add_argument("--slurm", metavar="PARTITION", help="print a Slurm command for each run")
    parser.add_argument("--data-root", metavar="DIR", help="folder of the data set of all configs")
    parser.add_argument(
        "--cfg-options", nargs="+", default=[], metavar="KEY=VALUE", help="overrides of all configs"
    )
    parser.add_argument("--list", action="store_true", help="print the papers' tables")
    parser.add_argument("--tables", default="*", metavar="PATTERN", help="names of tables to list")
    args = parser.parse_args()
    has_runs = bool(args.configs or args.runs)
    if not args.list and not (has_runs and args.out):
        parser.error("give configs or --runs, and --out")
    has_budget = args.budget is not None and args.budget >= 1
    if args.configs and not has_budget:
        parser.error("give --budget, the iterations of every run")
    if args.seeds < 1 or args.batch < 1:
        parser.error("--seeds and --batch must be at least 1")
    if args.rescore and (args.only or args.slurm):
        parser.error("--rescore writes tables of all runs: leave out --only and --slurm")
    return args


def read_tables(pattern: str = "*") -> list[dict[str, Any]]:
    """Tables of the papers whose name matches a shell pattern.

    Returns:
        Tables with their name (``table``), ``columns`` and ``rows``. A row has its name (``row``),
        the ``config`` and its overrides (``options``), the published figures in the order of the
        columns (``paper``, None without figures), and in some cases a ``note``. The config is None
        if the library has none for the row; the note then gives the reason.

    Raises:
        ValueError: If no table matches.
    """
    papers = []
    tables = []
    for method in METHODS:
        paper = method.paper()
        papers.append(paper)
        tables += paper["tables"]
    for table in read_json(shipped_path("configs/tables.json")):  # tables of several methods
        tables.append(_add_rows(table, papers=papers))
    chosen = [table for table in tables if fnmatchcase(table["table"], pattern)]
    if not chosen:
        raise InputError(
            f"no table is named {pattern!r}: compare.py --list names all {len(tables)}, and a "
            "pattern like 'GSMap*' chooses several."
        )
    return chosen


def _add_rows(table: dict[str, Any], papers: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """Add the rows of all methods to a table of ``configs/tables.json``.

    Args:
        table: Table with ``variants``: the overrides of the configs by the name of the variant.
        papers: Contents of the ``paper.json`` of all methods.

    Returns:
        Copy of the table with a row for each pair of variant and model. No figures are published
        for these rows.
    """
    configs: dict[str, str] = {}  # by name of the model
    for paper in papers:
        configs |= paper.get("shared_tables", {}).get(table["table"], {})
    rows = []
    for variant, options in table["variants"].items():
        for model, config in configs.items():
            name = f"{model}, {variant}"
            rows.append({"row": name, "config": config, "options": options, "paper": None})
    return {**table, "rows": rows}


def training_command(row: dict[str, Any]) -> str:
    """Command that trains the model of a row, or the reason why there is none."""
    if row["config"] is None:
        return f"({row['note']})"
    words = ["python", "tools/train.py", row["config"]]
    if row["options"]:
        words += ["--cfg-options", *row["options"]]
    return shlex.join(words)


def published_figures(table: dict[str, Any], row: dict[str, Any]) -> str:
    """Published mean APs and costs of a row; the APs of the classes if it has neither."""
    if row["paper"] is None:
        return "no figure"
    figures = dict(zip(table["columns"], row["paper"], strict=True))
    means = []
    aps = []
    for name, value in figures.items():
        text = f"{name} {'-' if value is None else value}"
        if name.endswith("/AP"):  # AP of a class
            aps.append(text)
        else:
            means.append(text)
    return ", ".join(means or aps)


def listing(tables: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the lines of ``--list``."""
    for table in tables:
        yield table["table"]
        for row in table["rows"]:
            yield f"  {row['row']}: {published_figures(table, row)}"
            yield f"    {training_command(row)}"
            if row["config"] is not None and "note" in row:
                yield f"    ({row['note']})"


def slurm_commands(runs: list[Run], partition: str) -> str:
    """Commands for the unfinished runs, one per line: this command with ``--only`` for each run.

    Args:
        runs: Chosen runs of the comparison.
        partition: Partition of the Slurm cluster.
    """
    # A parser with the single option --slurm returns all other words of this command line.
    slurm_option = argparse.ArgumentParser(add_help=False)
    slurm_option.add_argument("--slurm")
    _, other_words = slurm_option.parse_known_args()
    launch = ["srun", f"--partition={partition}", "--gres=gpu:1", "--ntasks=1", "--cpus-per-task=5"]
    commands = []
    for run in runs:
        if not run.is_done:
            words = [*launch, f"--job-name={run.label}", sys.executable, sys.argv[0], *other_words]
            commands.append(f"{shlex.join(words)} --only {run.label}")
    return "\n".join(commands)


def train(runs: list[Run]) -> None:
    """Train and test the unfinished runs, and print how each run ended."""
    # `execute` yields a run when it has ended. Its state is "done" or a sentence about the failure.
    for run, state in execute(runs):
        Progress.write(f"{run.label}: {state}")  # does not break a progress bar
        sys.stdout.flush()


def tabulate(runs: list[Run], args: argparse.Namespace) -> str:
    """Write tables and plots of all runs.

    Args:
        runs: Planned runs, trained or failed.
        args: Options of the command. ``args.runs`` names work folders of further finished runs.

    Returns:
        The tables, in Markdown.
    """
    results = []
    for run in runs:
        results.append(read_result(run.name, folder=run.folder, seed=run.seed))
    for text in args.runs:
        name, _, folder = text.partition("=")
        # Without "=", `folder` is empty and means the working folder.
        if not Path(folder or ".", "metrics.json").is_file():
            raise FileNotFoundError(
                f"{text!r} names no finished run: write NAME=DIR, where DIR holds metrics.json "
                "(tools/test.py --metrics-out)."
            )
        results.append(read_result(name, Path(folder)))
    check_one_test_set(results)  # raises an error if numbers of test samples or elements differ
    # Scores the runs again by the rules of --rescore, if any, and returns reports for the
    # precision-recall curves by name of the config.
    reports = apply_rescoring(results, args.rescore or {})
    rules = ", ".join(f"{key} {value}" for key, value in (args.rescore or {}).items())
    title = f"Comparison under {rules}" if rules else "Comparison"
    stem = "rescored" if rules else "comparison"
    command = shlex.join(["python", *sys.argv])
    tables = markdown(results, title, command)
    write_text(args.out / f"{stem}.md", tables)
    write_text(args.out / f"{stem}.json", as_json(results, title, command))
    if reports:
        save_figure(plot_precision_recall(reports), args.out / f"{stem}_precision_recall.png")
    curves = plot_iterations(results)
    if curves:
        save_figure(curves, args.out / "iterations.png")
    return f"{tables}\nwritten to {args.out}"


def rate_note(runs: Sequence[Run], batch: int) -> str:
    """Describe learning rates that are for different batch sizes; empty if there is one size.

    A comparison uses the rates of the configs as they are.

    Args:
        runs: Planned runs.
        batch: Number of samples of an iteration.
    """
    names_of: dict[int, list[str]] = {}  # names of configs by the batch size of their rates
    for run in runs:
        size = (run.settings["auto_scale_lr"] or {}).get("base_batch_size")
        if size and run.name not in names_of.setdefault(size, []):
            names_of[size].append(run.name)
    if len(names_of) < 2:
        return ""
    texts = [f"{size} ({', '.join(names)})" for size, names in sorted(names_of.items())]
    return (
        f"note: learning rates are those of the configs, for batches of {' and '.join(texts)}; "
        f"here a batch has {batch}. optim_wrapper.optimizer.lr sets another one."
    )


def main() -> str:
    args = parse_args()
    if args.list:
        return "\n".join(listing(read_tables(args.tables)))
    runs: list[Run] = []
    if args.configs:
        options = [f"data_root={args.data_root}"] if args.data_root else []
        protocol = Protocol(
            seeds=args.seeds,
            budget=args.budget,
            out=args.out,
            batch=args.batch,
            init=args.init,
            options=(*options, *args.cfg_options),
        )
        entries = [parse_entry(text) for text in args.configs]
        runs = plan(entries, protocol)
        if not args.slurm and (note := rate_note(runs, args.batch)):
            print(note)
    # Without --only, `args.only` is None, and all runs are chosen.
    chosen = [run for run in runs if args.only in (None, run.label)]
    if args.only and not chosen:
        labels = [run.label for run in runs]
        raise InputError(f"no run has the name {args.only}; there are {labels}.")
    if args.slurm:
        return slurm_commands(chosen, args.slurm)
    if not args.rescore:
        train(chosen)
    tables = "" if args.only else tabulate(runs, args)
    failed = []
    for run in chosen:
        if not run.is_done:
            failed.append(run.label)
    if failed:
        # The error ends the command with an exit code, so the tables are printed before it.
        sys.stdout.write(f"{tables}\n")
        raise WorkError(f"{', '.join(failed)} did not end: the table names the reason.")
    return tables


if __name__ == "__main__":
    run_command(main)
