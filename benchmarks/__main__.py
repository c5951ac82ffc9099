"""Measure speed and memory: ``python -m benchmarks SUBCOMMAND --help``."""

import argparse

from benchmarks import evaluation, masks, model_commands, raster

# each adds its own parser, with ``run`` as a default
SUBCOMMANDS = (
    evaluation.add_parser,
    masks.add_parser,
    model_commands.add_parser,
    raster.add_parser,
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    subparsers = parser.add_subparsers(required=True)
    for add_parser in SUBCOMMANDS:
        add_parser(subparsers)
    args = parser.parse_args()
    args.run(args)


if __name__ == "__main__":
    main()
