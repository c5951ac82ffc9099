#!/usr/bin/env python
"""Turn an info file of MapTR or MapTRv2 into an annotation file (docs/data.md)."""

import argparse
import shlex
import sys

from gsmap.converters.command_line import run_command


def convert() -> str:
    from gsmap.converters.infos import add_arguments, run

    parser = argparse.ArgumentParser(description=__doc__)
    add_arguments(parser)
    return run(parser.parse_args(), shlex.join(["python", *sys.argv]))


if __name__ == "__main__":
    run_command(convert)
