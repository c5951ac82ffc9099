#!/usr/bin/env python
"""Make data and annotation files: ``python tools/create_data.py COMMAND --help``.

Each command is a module of the package with ``add_arguments(parser)`` and ``run(arguments)``, where
``arguments.command`` is the command line. It is imported only when needed.
"""

import argparse
import importlib
import shlex
import sys

from gsmap.utils.cli import CommandParser, run_command
from gsmap.utils.ray_shards import run_on_ray
from gsmap.utils.shards import without_options
from gsmap.utils.terminal import printable

# Module and help text of each command.
COMMANDS = {
    "minicity": ("minicity.cli", "generate the MiniCity data set"),
    "nuscenes": ("mapdata.nuscenes.convert", "convert nuScenes or MiniCity"),
    "av2": ("mapdata.argoverse2.convert", "convert Argoverse 2 logs"),
    "av2-render": (
        "minicity.argoverse2_render",
        "render camera images for real Argoverse 2 logs",
    ),
    "py123d": ("mapdata.py123d.convert", "convert logs of py123d"),
    "infos": ("mapdata.infos.convert", "convert an info file of MapTR or its successors"),
    "split": ("mapdata.splitter", "split scenes by place, at a distance from each other"),
    "overlap": ("mapdata.overlap", "list the validation samples that lie near training"),
    "occlusion": (
        "mapdata.nuscenes.occlusion",
        "group samples by the share of the map that boxes hide",
    ),
    "check": ("mapdata.check", "check annotation files completely"),
    "fiftyone": (
        "gsmap.visualization.fiftyone",
        "write camera images with map elements for FiftyOne",
    ),
    "export": ("mapdata.vectors_json", "write an annotation file's vectors as JSON"),
}


def make() -> str | None:
    """Run the chosen command and return its summary."""
    parser = CommandParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    # Only the chosen command gets its options, because they are in its module. The other commands
    # are listed in the help.
    chosen = next((word for word in sys.argv[1:] if word in COMMANDS), None)
    for name, (module, text) in COMMANDS.items():
        subparser = commands.add_parser(name, help=text, description=text)
        if name == chosen:
            importlib.import_module(module).add_arguments(subparser)
    arguments = parser.parse_args()
    if getattr(arguments, "executor", None):  # only some commands have --executor
        return run_on_ray(arguments, sys.argv)
    module, _ = COMMANDS[arguments.command]
    # From here on, `command` is not the name of the command but the whole command line, which is
    # recorded in the output. Without --shard, it is equal for all shards, and it creates the
    # complete output again.
    words = without_options(sys.argv, "--shard")
    # `printable` escapes control characters, which annotation files do not accept.
    arguments.command = printable(shlex.join(["python", *words]))
    return importlib.import_module(module).run(arguments)


if __name__ == "__main__":
    run_command(make)
