"""Measure speed, memory and size: ``python -m benchmarks COMMAND --help``."""

import importlib
import sys

from gsmap.utils.cli import CommandParser, run_command

# Module of each command, in this package. A module has `add_arguments(parser)` and `run(args)`, and
# its docstring is the help text. Only the module of the requested command is imported, as the
# libraries of other commands would add to the measured memory.
COMMANDS = {
    "data": "data_commands",
    "eval": "evaluation",
    "export": "export",
    "fps": "fps",
    "heads": "heads",
    "kernels": "kernels",
    "launches": "launches",
    "live": "live",
    "masks": "masks",
    "minicity": "minicity",
    "mutations": "mutations",
    "parameters": "parameters",
    "prior": "prior",
    "profile": "profile",
    "raster": "raster",
    "shape": "shape",
    "step": "step",
    "stream": "stream",
    "vectorize": "vectorize",
}


def main() -> None:
    """Run the benchmark of the command line."""
    parser = CommandParser(description=__doc__)
    subparsers = parser.add_subparsers(required=True)
    # The command in the first argument. The set is empty if this argument is no command, such as
    # --help. Then all commands are added, so that the help lists them.
    requested = COMMANDS.keys() & set(sys.argv[1:2])
    for name in sorted(requested or COMMANDS):
        module = importlib.import_module(f"benchmarks.{COMMANDS[name]}")
        text = str(module.__doc__)
        command = subparsers.add_parser(name, help=text.splitlines()[0], description=text)
        module.add_arguments(command)
        command.set_defaults(run=module.run)
    args = parser.parse_args()
    args.run(args)


if __name__ == "__main__":
    run_command(main)
