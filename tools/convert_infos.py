#!/usr/bin/env python
"""Turn an info file of MapTR or MapTRv2 into an annotation file (docs/data.md)."""

import argparse
import shlex
import sys

from gsmap.datasets.converters.convert_infos import add_arguments, run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    add_arguments(parser)
    try:
        print(run(parser.parse_args(), shlex.join(["python", *sys.argv])))
    except (OSError, ValueError) as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
