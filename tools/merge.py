#!/usr/bin/env python
"""Join the parts that ``--shard I/N`` of other commands made: ``python tools/merge.py FILE ...``.

FILE is what the command makes without ``--shard``: an annotation file, results or metrics. All of
its N parts must lie beside it. What comes out is the same, byte for byte (docs/fleet.md).
"""

from pathlib import Path

from gsmap.datasets.annotations.file import SHARD_KIND as ANNOTATIONS
from gsmap.datasets.annotations.file import merge_annotations
from gsmap.utils.cli import CommandParser, run_command
from gsmap.utils.shards import find_shards

MERGE = {ANNOTATIONS: merge_annotations}


def main(argv: list[str] | None = None) -> str:
    parser = CommandParser(description=__doc__)
    parser.add_argument("targets", metavar="FILE", type=Path, nargs="+", help="file to make")
    lines = []
    for target in parser.parse_args(argv).targets:
        shards = find_shards(target)
        kind = shards[0].manifest["kind"]
        if kind not in MERGE:
            raise ValueError(f"{shards[0].path} holds {kind!r}, of which no whole is made.")
        count = MERGE[kind](target, shards)
        lines.append(f"{target}: {count} samples of {len(shards)} shards")
    return "\n".join(lines)


if __name__ == "__main__":
    run_command(main)
