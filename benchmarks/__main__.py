"""Measure speed, memory and size: ``python -m benchmarks COMMAND --help``."""

import importlib
import sys

from gsmap.utils.cli import CommandParser, run_command

# command -> module, imported when asked for: the libraries of one would count in another's memory
COMMANDS = {
    "data": "data_commands",
    "eval": "evaluation",
    "export": "export",
    "fps": "fps",
    "heads": "heads",
    "masks": "masks",
    "minicity": "minicity",
    "parameters": "parameters",
    "profile": "profile",
    "raster": "raster",
    "step": "step",
}


def main() -> None:
    parser = CommandParser(description=__doc__)
    subparsers = parser.add_subparsers(required=True)
    asked_for = COMMANDS.keys() & set(sys.argv[1:2])
    for name in sorted(asked_for or COMMANDS):
        importlib.import_module(f"benchmarks.{COMMANDS[name]}").add_parser(subparsers)
    args = parser.parse_args()
    args.run(args)


if __name__ == "__main__":
    run_command(main)
