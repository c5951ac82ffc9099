"""Commands of the generated data set: ``python -m minicity generate`` and ``draw``."""

import argparse
import shlex
import sys

from gsmap.utils.cli import CommandParser, run_command
from minicity import cli, devkit_plots


def main() -> str:
    """Run the command of the command line.

    Returns:
        Summary of the command's result for the user.
    """
    parser = CommandParser(prog="python -m minicity", description=__doc__)
    commands = parser.add_subparsers(required=True)
    # Each module has `add_arguments`, and `run`, which returns the summary.
    for name, module in (("generate", cli), ("draw", devkit_plots)):
        command = commands.add_parser(name, help=module.__doc__, description=module.__doc__)
        module.add_arguments(command)
        command.set_defaults(run=module.run)
    arguments: argparse.Namespace = parser.parse_args()
    # The command line as text, which `generate` writes to its summary.
    arguments.command = shlex.join(["python", "-m", "minicity", *sys.argv[1:]])
    return arguments.run(arguments)


if __name__ == "__main__":
    run_command(main)  # prints the summary, and errors of the user in one line
