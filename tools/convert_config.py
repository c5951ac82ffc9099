#!/usr/bin/env python
"""Convert a config of the original MapTR, MapTRv2, GeMap or MapVR to ours.

The file is read, not run. Settings without a counterpart are printed. Example:
    python tools/convert_config.py maptr_tiny_r50_24e.py configs/mine/maptr_tiny.py
"""

import argparse
from pathlib import Path

from gsmap.utils.cli import CommandParser, output_file, run_command
from gsmap.utils.files import write_text
from gsmap.utils.shipped import shipped
from mapdata.upstream_configs.reader import read_assignments
from mapdata.upstream_configs.upstream import convert_upstream, merge, python_text


def parse_args() -> argparse.Namespace:
    parser = CommandParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("source", type=Path, help="config of an original repository")
    parser.add_argument("target", type=output_file, help="config to write")
    return parser.parse_args()


def convert(source: Path, target: Path) -> str:
    """Write the converted config and return what to say of it."""
    settings = read_assignments(source)
    try:
        conversion = convert_upstream(settings)
        text = python_text(merge(conversion, shipped("configs")))
    except (
        ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RecursionError,
    ) as error:  # fmt: skip
        raise ValueError(f"{source} cannot be converted: {error}") from error
    write_text(target, text)
    lines = [f"{target} is written: configs/{conversion.base} with the settings of {source}"]
    if conversion.unplaced:
        lines.append("not placed, see docs/migration.md:")
        lines += [f"  {setting}" for setting in conversion.unplaced]
    return "\n".join(lines)


def main() -> str:
    args = parse_args()
    return convert(args.source, args.target)


if __name__ == "__main__":
    run_command(main)
