"""Parts of one command's work for several machines, and the check that all parts fit.

A shard's file stands where the whole would, as ``NAME.00003-of-00016.SUFFIX``, with a manifest
beside it. The manifest comes last and counts: a file without one is not finished.
"""

import argparse
import glob
import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from gsmap import __version__
from gsmap.utils.errors import InputError
from gsmap.utils.files import write_text

Items = TypeVar("Items", bound=Sequence[Any])

_COMMON = ("kind", "target", "of", "version", "input", "options")
_TYPES = {  # of a manifest's entries
    **dict.fromkeys(("kind", "target", "version", "input", "sha256"), str),
    **dict.fromkeys(("shard", "of", "samples", "bytes"), int),
    "options": dict,
}
_MOST = 99_999  # shards of a file: numbers in names have five digits


@dataclass(frozen=True)
class Shard:
    """One of several equal parts of an ordered list of work; ``WHOLE`` is all of it.

    Args:
        index: Which part, from 0.
        count: How many parts there are; 0 for the whole, unnamed.
    """

    index: int
    count: int

    @classmethod
    def parse(cls, text: str) -> "Shard":
        """Read ``I/N``; I counts from 0.

        Raises:
            argparse.ArgumentTypeError: If it is anything else.
        """
        match = re.fullmatch(r"(\d{1,5})/(\d{1,5})", text)
        if not match or int(match[1]) >= int(match[2]):
            raise argparse.ArgumentTypeError(
                f"expected I/N with I from 0 to N - 1, such as 0/16 or 15/16, got {text!r}"
            )
        return cls(int(match[1]), int(match[2]))

    def part(self, items: Items) -> Items:
        """Return this shard's items: neighbours, and in the order of the shards all of them."""
        if not self.count:
            return items
        start, stop = (len(items) * i // self.count for i in (self.index, self.index + 1))
        return items[start:stop]  # type: ignore[return-value]

    def path_of(self, target: Path) -> Path:
        """Return where this shard of a file goes."""
        if not self.count:
            return target
        number = f"{self.index:05d}-of-{self.count:05d}"
        return target.with_name(f"{target.stem}.{number}{target.suffix}")

    def seal(
        self, target: Path, kind: str, source: str, options: Mapping[str, Any], samples: int
    ) -> None:
        """Write the manifest of this shard's file, which is whole; nothing for the whole.

        Args:
            target: Where the whole would be.
            kind: What the file holds; says how shards are joined.
            source: Digest of what it was made from.
            options: What else decides its content, in JSON's types.
            samples: How many samples it holds.
        """
        if self.count:
            path = self.path_of(target)
            manifest = {
                "kind": kind,
                "target": target.name,
                "shard": self.index,
                "of": self.count,
                "version": __version__,
                "input": source,
                "options": options,
                "samples": samples,
                "bytes": path.stat().st_size,
                "sha256": digest(path),
            }
            write_text(_manifest_path(path), json.dumps(manifest, indent=1) + "\n")


WHOLE = Shard(0, 0)


class ShardFile(NamedTuple):
    """A shard's file and what its manifest says."""

    path: Path
    manifest: dict[str, Any]


def add_shard_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--shard I/N``, and the options that make all shards on a cluster."""
    group = parser.add_argument_group("several machines (docs/scale.md)")
    group.add_argument(
        "--shard",
        type=Shard.parse,
        default=WHOLE,
        metavar="I/N",
        help="do part I of N, I from 0 to N - 1; tools/merge.py joins the parts",
    )
    group.add_argument("--executor", choices=("ray",), help="make all --shards on a Ray cluster")
    group.add_argument("--shards", type=int, default=16, help="how many (default: %(default)s)")
    group.add_argument(
        "--per-shard",
        nargs="+",
        type=_amount,
        default=[],
        metavar="NAME=AMOUNT",
        help="resources of each in Ray, such as num_cpus=4 num_gpus=1 (default: num_cpus=1)",
    )


def _amount(text: str) -> tuple[str, float]:
    """Read an amount of a resource."""
    name, _, amount = text.partition("=")
    if name not in ("num_cpus", "num_gpus", "memory"):
        raise argparse.ArgumentTypeError(f"expected num_cpus=, num_gpus= or memory=, got {text!r}")
    return name, float(amount)


def without_options(words: Sequence[str], *names: str) -> list[str]:
    """Return the words of a command without some of its options, of one value each."""
    pairs = zip(["", *words], words, strict=False)
    return [w for before, w in pairs if before not in names and w.split("=")[0] not in names]


def digest(path: Path) -> str:
    """Return the SHA-256 of a file's content."""
    total = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            total.update(block)
    return total.hexdigest()


def digest_of_common(file: ShardFile) -> str:
    """Return a digest of what all shards of one file have in common."""
    common = {name: file.manifest[name] for name in _COMMON}
    return hashlib.sha256(json.dumps(common, sort_keys=True).encode()).hexdigest()


def read_shard(path: Path) -> ShardFile:
    """Return a shard's file with its manifest, the one checked against the other.

    Raises:
        FileNotFoundError: If one of them is missing.
        ValueError: If the manifest is none, or the file is not the one that it tells of.
    """
    beside = _manifest_path(path)
    try:
        manifest = json.loads(beside.read_text(encoding="utf-8"))
        wrong = [name for name, kind in _TYPES.items() if type(manifest[name]) is not kind]
        shard = Shard(manifest["shard"], manifest["of"])
        if wrong or not 0 <= shard.index < shard.count <= _MOST or manifest["samples"] < 0:
            raise InputError(f"{wrong or ['shard', 'of', 'samples']} cannot be")
        right = shard.path_of(path.with_name(manifest["target"]))
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{beside} is damaged ({error!r}): make that shard again.") from error
    same_size = path.is_file() and path.stat().st_size == manifest["bytes"]
    if not same_size or digest(path) != manifest["sha256"]:
        raise InputError(f"{path} is missing, or not what its manifest tells of: make it again.")
    if path != right:
        raise InputError(
            f"{path} is another shard by its manifest: {shard.index} of {shard.count} of "
            f"{manifest['target']}; take it away, and make the right one."
        )
    return ShardFile(path, manifest)


def find_shards(target: Path) -> list[ShardFile]:
    """Return all shards of a file, in their order, from beside it.

    Raises:
        FileNotFoundError: If there is none, or one is missing.
        ValueError: If one is damaged, another one than its name says, or of other work: another
            number of shards, other options, another input or version.
    """
    pattern = f"{glob.escape(target.stem)}.*-of-*{glob.escape(target.suffix)}.manifest"
    found = [read_shard(path.with_suffix("")) for path in sorted(target.parent.glob(pattern))]
    if not found:
        raise FileNotFoundError(f"there are no shards of {target}: --shard I/N makes them.")
    first = found[0]
    for other in found[1:]:
        names = _differences(first.manifest, other.manifest)
        if names:
            raise InputError(
                f"{first.path} and {other.path} are shards of different work, by {names}: make "
                "those anew that are not of this."
            )
    count, there = first.manifest["of"], {file.manifest["shard"] for file in found}
    missing = [str(index) for index in range(count) if index not in there]
    if missing:
        some = ", ".join(missing[:10]) + (", ..." if len(missing) > 10 else "")
        raise FileNotFoundError(
            f"{target} lacks {len(missing)} of its {count} shards: {some}; run the command again "
            f"with --shard {missing[0]}/{count}."
        )
    return found


def _manifest_path(path: Path) -> Path:
    return path.with_name(f"{path.name}.manifest")


def _differences(first: Mapping[str, Any], other: Mapping[str, Any]) -> str:
    """Say by which entries, and which options, two manifests tell of different work."""
    pairs = {name: (first[name], other[name]) for name in _COMMON if name != "options"}
    one, two = first["options"], other["options"]
    pairs |= {name: (one.get(name), two.get(name)) for name in {**one, **two}}
    differing = {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}
    return ", ".join(f"{name} ({a!r:.80}, {b!r:.80})" for name, (a, b) in differing.items())
