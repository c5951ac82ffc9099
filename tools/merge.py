#!/usr/bin/env python
"""Join the parts that commands with ``--shard I/N`` wrote: ``python tools/merge.py FILE ...``.

FILE is the output that the command would write without ``--shard``: an annotation file, results or
metrics. Its N parts must lie in its folder. The joined file is identical to this output, byte for
byte (docs/scale.md).
"""

from pathlib import Path

from gsmap.datasets.annotations.file import SHARD_KIND as ANNOTATIONS
from gsmap.datasets.annotations.file import merge_annotations
from gsmap.evaluation.core.match_files import SHARD_KIND as MATCHES
from gsmap.evaluation.core.match_files import report_shards
from gsmap.evaluation.core.report import format_table, write_figures
from gsmap.evaluation.core.results_json import SHARD_KIND as RESULTS
from gsmap.evaluation.core.results_json import merge_results
from gsmap.utils.cli import CommandParser, EachOnce, output_file, run_command
from gsmap.utils.errors import InputError
from gsmap.utils.extras import import_own
from gsmap.utils.shards import ShardFile, find_shards
from gsmap.utils.words import format_count


def merge_matches(path: Path, shards: list[ShardFile]) -> int:
    """Compute the metrics of all shards together, write them to a file and print them.

    The notes of the shards are printed, too.

    Args:
        path: File to write, as JSON.
        shards: All parts, each with the matches of its samples.

    Returns:
        The number of samples of all shards.
    """
    reports, notes = report_shards(shards)
    for report in reports:
        print(format_table(report) + "\n")
    for note in notes:
        print(f"note: {note}")
    write_figures(path, reports)
    return sum(shard.manifest["samples"] for shard in shards)


# Functions that join the parts (shards) of a kind of file. They take the path of the file and the
# parts, and return the number of samples.
MERGE = {ANNOTATIONS: merge_annotations, RESULTS: merge_results, MATCHES: merge_matches}


def main(argv: list[str] | None = None) -> str:
    """Join the parts of each file; return a line for each, which `run_command` prints."""
    parser = CommandParser(description=__doc__)
    parser.add_argument(
        "targets", metavar="FILE", type=output_file, nargs="+", action=EachOnce, help="file to make"
    )
    parser.add_argument(
        "--custom-imports",
        nargs="+",
        default=[],
        metavar="MODULE",
        help="modules that register your own metrics, if the parts have such metrics",
    )
    args = parser.parse_args(argv)
    for module in args.custom_imports:
        import_own(module)
    lines = []
    for target in args.targets:
        shards = find_shards(target)  # raises an error if one is missing or differs from the others
        kind = shards[0].manifest["kind"]
        if kind not in MERGE:
            raise InputError(f"{shards[0].path} holds {kind!r}, which cannot be joined.")
        count = MERGE[kind](target, shards)
        lines.append(
            f"{target}: {format_count(count, 'sample')} of {format_count(len(shards), 'shard')}"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    run_command(main)
