#!/usr/bin/env python
"""List every row of the papers' tables with the command that trains it here.

``configs/tables.json`` holds the rows: figures in percent by our metrics' names, config, overrides.

Examples:
    python tools/compare.py --list
    python tools/compare.py --list --tables 'MapVR Table 5*'
"""

import argparse
import json
import shlex
from collections.abc import Iterator
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from gsmap.utils.cli import run_command

TABLES = Path(__file__).resolve().parents[1] / "configs/tables.json"


def parse_args() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--list", action="store_true", required=True, help="print the rows")
    parser.add_argument("--tables", default="*", metavar="PATTERN", help="names of tables to list")
    return parser.parse_args()


def read_tables(pattern: str = "*") -> list[dict[str, Any]]:
    """Return the tables whose name fits.

    Raises:
        ValueError: If there is none.
    """
    tables = json.loads(TABLES.read_text())
    chosen = [table for table in tables if fnmatchcase(table["table"], pattern)]
    if not chosen:
        names = ", ".join(table["table"] for table in tables)
        raise ValueError(f"no table is named {pattern!r}; there are: {names}.")
    return chosen


def command_of(row: dict[str, Any]) -> str:
    """Return the command that trains a row's model, or why there is none."""
    if row["config"] is None:
        return f"({row['note']})"
    words = ["python", "tools/train.py", row["config"]]
    if row["options"]:
        words += ["--cfg-options", *row["options"]]
    return shlex.join(words)


def figures_of(table: dict[str, Any], row: dict[str, Any]) -> str:
    """Return the paper's mean APs of a row; its first figure where the table has no mean."""
    if row["paper"] is None:
        return "no figure"
    both = dict(zip(table["columns"], row["paper"], strict=True))
    means = {name: value for name, value in both.items() if name.endswith("/mAP")} or both
    return ", ".join(f"{name} {'-' if v is None else v}" for name, v in means.items())


def lines(tables: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the listing."""
    for table in tables:
        yield table["table"]
        for row in table["rows"]:
            yield f"  {row['row']}: {figures_of(table, row)}"
            yield f"    {command_of(row)}"
            if row["config"] is not None and "note" in row:
                yield f"    ({row['note']})"


def main() -> None:
    args = parse_args()
    run_command(lambda: "\n".join(lines(read_tables(args.tables))))


if __name__ == "__main__":
    main()
