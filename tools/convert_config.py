#!/usr/bin/env python
"""Convert a config of the original MapTR, or of a method built on its code, to a config of GSMap.

The file is read, not run. Settings without a counterpart are printed. If settings of the model are
among them, the conversion ends with an error, unless --allow-changes is given. Example:
    python tools/convert_config.py maptr_tiny_r50_24e.py configs/mine/maptr_tiny.py
"""

import argparse
from pathlib import Path

from gsmap.utils.cli import CommandParser, output_file, run_command
from gsmap.utils.errors import InputError
from gsmap.utils.files import write_text
from gsmap.utils.shipped import shipped_path
from mapdata.upstream_configs.reader import read_assignments
from mapdata.upstream_configs.upstream import convert_upstream, merge, python_text


def parse_args() -> argparse.Namespace:
    parser = CommandParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("source", type=Path, help="config of an original repository")
    parser.add_argument("target", type=output_file, help="config to write")
    parser.add_argument(
        "--allow-changes",
        action="store_true",
        help="leave out settings of the model without a counterpart, which changes the model",
    )
    return parser.parse_args()


def convert(source: Path, target: Path, allow_changes: bool = False) -> str:
    """Write the converted config.

    Args:
        source: Config of an original repository; it is read as data.
        target: Config to write. It is not written in case of an error.
        allow_changes: Whether to leave out settings of the model that have no counterpart.

    Returns:
        Lines with the base config and all settings that have no counterpart.

    Raises:
        ValueError: If the config cannot be read or converted, or if settings of the model have no
            counterpart and ``allow_changes`` is False.
    """
    settings = read_assignments(source)
    try:
        # `unplaced` of the conversion has the settings without a counterpart, as `name = value`.
        conversion = convert_upstream(settings)
        # The settings are merged into a config of GSMap, and the result is formatted as Python.
        text = python_text(merge(conversion, shipped_path("configs")))
    except (
        ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RecursionError,
    ) as error:  # fmt: skip
        # Unexpected types, sizes or depths of values can cause all of these.
        raise InputError(f"{source} cannot be converted: {error}") from error
    model_settings = []  # settings of the model without a counterpart
    other_settings = []  # other settings without a counterpart
    for setting in conversion.unplaced:
        if setting.startswith("model."):
            model_settings.append(setting)
        else:
            other_settings.append(setting)
    if model_settings and not allow_changes:
        examples = ", ".join(model_settings[:3])[:300]
        raise InputError(
            f"{source} would become another model, since {len(model_settings)} of its settings "
            f"have no counterpart: {examples}... --allow-changes leaves them out."
        )
    write_text(target, text)
    lines = [f"{target} is written: configs/{conversion.base} with the settings of {source}"]
    unplaced = {
        "this is another model, without the settings": model_settings,
        "other settings without a counterpart": other_settings,
    }
    for title, names in unplaced.items():
        if names:
            lines.append(f"{title} (see docs/migration.md):")
            lines += [f"  {name}" for name in names]
    return "\n".join(lines)


def main() -> str:
    """Convert with the options of the command line; `run_command` prints the returned text."""
    args = parse_args()
    return convert(args.source, args.target, args.allow_changes)


if __name__ == "__main__":
    run_command(main)
