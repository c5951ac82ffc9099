#!/usr/bin/env python
"""Make data and annotation files: ``python tools/create_data.py COMMAND --help``.

Each command lives in the package as a module with ``add_arguments(parser)`` and ``run(arguments,
command)``, imported only when it is asked for.
"""

import argparse
import importlib
import shlex
import signal
import sys

COMMANDS = {
    "minicity": ("gsmap.datasets.minicity.cli", "generate the MiniCity data set"),
    "nuscenes": ("gsmap.datasets.converters.nuscenes_cli", "convert nuScenes or MiniCity"),
    "av2": ("gsmap.datasets.converters.argoverse2", "convert Argoverse 2 logs"),
    "av2-render": (
        "gsmap.datasets.converters.argoverse2_render",
        "render camera images for real Argoverse 2 logs",
    ),
    "export": ("gsmap.datasets.converters.export", "write an annotation file's vectors as JSON"),
}


def stop(number: int, _frame: object) -> None:
    """Leave through the clean-up of half-written files, as Ctrl-C does."""
    sys.exit(128 + number)


def main() -> None:
    signal.signal(signal.SIGTERM, stop)
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    asked_for = next((word for word in sys.argv[1:] if word in COMMANDS), None)
    for name, (module, text) in COMMANDS.items():
        subparser = commands.add_parser(name, help=text, description=text)
        if name == asked_for:
            importlib.import_module(module).add_arguments(subparser)
    arguments = parser.parse_args()
    module, _ = COMMANDS[arguments.command]
    typed = shlex.join(["python", *sys.argv])
    try:
        result = importlib.import_module(module).run(arguments, typed)
    except (OSError, ValueError, RuntimeError) as error:
        sys.exit(f"error: {error}")
    if result is not None:
        print(result)


if __name__ == "__main__":
    main()
