"""Shards of a command's work for several machines, and checks that the shards belong together.

The file of a shard lies in the folder of the complete file, as ``NAME.00003-of-00016.SUFFIX``, with
a manifest beside it. The manifest is written last, so a file without a manifest is incomplete.
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
from gsmap.utils.inputs import require_own_file

Items = TypeVar("Items", bound=Sequence[Any])

# Entries of a manifest that are equal for all shards of a file (see `Shard.write_manifest`).
_SHARED_ENTRIES = ("kind", "target", "of", "version", "input", "options")
_ENTRY_TYPES = {  # types of the entries of a manifest
    "kind": str,
    "target": str,
    "version": str,
    "input": str,
    "sha256": str,
    "shard": int,
    "of": int,
    "samples": int,
    "bytes": int,
    "options": dict,
}
_MAX_SHARDS = 99_999  # numbers in file names have five digits


@dataclass(frozen=True)
class Shard:
    """One of several equal parts of an ordered list of work; ``WHOLE`` is the complete list.

    Args:
        index: Index of the part, from 0.
        count: Number of parts; 0 for the complete list.
    """

    index: int
    count: int

    @classmethod
    def parse(cls, text: str) -> "Shard":
        """Parse ``I/N``, with I from 0 to N - 1.

        Raises:
            argparse.ArgumentTypeError: If the text has another form.
        """
        match = re.fullmatch(r"(\d{1,5})/(\d{1,5})", string=text)
        if not match or int(match[1]) >= int(match[2]):
            raise argparse.ArgumentTypeError(
                f"expected I/N with I from 0 to N - 1, such as 0/16 or 15/16, got {text!r}"
            )
        return cls(index=int(match[1]), count=int(match[2]))

    def part(self, items: Items) -> Items:
        """Return the contiguous range of items of this shard; the shards together cover all."""
        if not self.count:
            return items
        start = len(items) * self.index // self.count
        stop = len(items) * (self.index + 1) // self.count
        return items[start:stop]  # type: ignore[return-value]

    def path_of(self, target: Path) -> Path:
        """Return the path of this shard, given the path of the complete file."""
        if not self.count:
            return target
        number = f"{self.index:05d}-of-{self.count:05d}"
        return target.with_name(f"{target.stem}.{number}{target.suffix}")

    def require_own(self, target: Path, mark: bytes) -> None:
        """Check that this shard's file and manifest will not replace files of other programs.

        Args:
            target: Path of the complete file. For `WHOLE`, nothing is checked, because the user has
                chosen this path.
            mark: Bytes near the start or near the end of each file of this kind, by which a shard
                of an earlier run is recognised. Such a file may be replaced.

        Raises:
            ValueError: If another program's file has the name of the shard or of its manifest.
        """
        if self.count:
            path = self.path_of(target)
            require_own_file(path, mark)
            # `kind` is the first entry of every manifest.
            require_own_file(_manifest_path(path), mark=b'"kind":')

    def write_manifest(
        self, target: Path, kind: str, source: str, options: Mapping[str, Any], samples: int
    ) -> None:
        """Write the manifest of this shard, whose file must be finished.

        For `WHOLE`, nothing is written.

        Args:
            target: Path of the complete file.
            kind: Kind of the content, which determines how shards are merged.
            source: Digest of the input.
            options: Further settings that the content depends on, as JSON types.
            samples: Number of samples in the shard.
        """
        if not self.count:
            return
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
        write_text(_manifest_path(path), text=json.dumps(manifest, indent=1) + "\n")


WHOLE = Shard(index=0, count=0)


class ShardFile(NamedTuple):
    """File of a shard with its manifest.

    Attributes:
        path: Path of the file.
        manifest: Entries of the manifest, as `Shard.write_manifest` writes them.
    """

    path: Path
    manifest: dict[str, Any]


def add_shard_options(parser: argparse.ArgumentParser) -> None:
    """Add ``--shard I/N``, and the options that compute all shards on a cluster."""
    group = parser.add_argument_group("several machines (docs/scale.md)")
    group.add_argument(
        "--shard",
        type=Shard.parse,
        default=WHOLE,
        metavar="I/N",
        help="do part I of N, I from 0 to N - 1; tools/merge.py joins the parts",
    )
    group.add_argument("--executor", choices=("ray",), help="make all --shards on a Ray cluster")
    group.add_argument(
        "--shards",
        type=int,
        default=16,
        help="number of shards with --executor (default: %(default)s)",
    )
    group.add_argument(
        "--per-shard",
        nargs="+",
        type=_parse_amount,
        default=[],
        metavar="NAME=AMOUNT",
        help="resources that Ray reserves for each shard, such as num_cpus=4 num_gpus=1 "
        "(default: num_cpus=1)",
    )


def _parse_amount(text: str) -> tuple[str, float]:
    """Parse ``NAME=AMOUNT`` of a resource of Ray."""
    name, _, amount = text.partition("=")
    if name not in ("num_cpus", "num_gpus", "memory"):
        raise argparse.ArgumentTypeError(f"expected num_cpus=, num_gpus= or memory=, got {text!r}")
    return name, float(amount)


def without_options(words: Sequence[str], *names: str) -> list[str]:
    """Remove options with one value each from a command.

    Args:
        words: Words of the command.
        *names: Options to remove, given as ``--option VALUE`` or ``--option=VALUE``.

    Returns:
        The remaining words of the command.
    """
    remaining_words = []
    previous = ""
    for word in words:
        option, _, _ = word.partition("=")
        follows_option = previous in names  # the word is the value of an option to remove
        if not follows_option and option not in names:
            remaining_words.append(word)
        previous = word
    return remaining_words


def digest(path: Path) -> str:
    """Return the SHA-256 of the content of a file, as hexadecimal digits."""
    sha256 = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            sha256.update(block)
    return sha256.hexdigest()


def digest_of_common(file: ShardFile) -> str:
    """Return a digest of the manifest entries that all shards of one file share."""
    common = {name: file.manifest[name] for name in _SHARED_ENTRIES}
    text = json.dumps(common, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def read_shard(path: Path) -> ShardFile:
    """Read the manifest of a shard, and check that it describes the file.

    Args:
        path: Path of the shard's file.

    Raises:
        FileNotFoundError: If the manifest is missing.
        ValueError: If the manifest is damaged, or if it does not describe the file.
    """
    manifest_path = _manifest_path(path)
    try:
        manifest = json.loads(manifest_path.read_text(encoding="utf-8"))
        # Types are compared exactly, because `isinstance` would accept True as a number.
        wrong_names = [
            name for name, kind in _ENTRY_TYPES.items() if type(manifest[name]) is not kind
        ]
        shard = Shard(index=manifest["shard"], count=manifest["of"])
        is_shard = 0 <= shard.index < shard.count <= _MAX_SHARDS
        if wrong_names or not is_shard or manifest["samples"] < 0:
            raise InputError(f"wrong values of {wrong_names or ['shard', 'of', 'samples']}")
        named_path = shard.path_of(path.with_name(manifest["target"]))
    # An `InputError` is a ValueError, so the error above also gets the path of the manifest here.
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        message = f"{manifest_path} is damaged ({error!r}): make that shard again."
        raise InputError(message) from error
    same_size = path.is_file() and path.stat().st_size == manifest["bytes"]
    if not same_size or digest(path) != manifest["sha256"]:
        raise InputError(f"{path} is missing or does not fit its manifest: make it again.")
    if path != named_path:
        raise InputError(
            f"{path} has the name of another shard than its manifest, which names shard "
            f"{shard.index} of {shard.count} of {manifest['target']}: remove it, and make the "
            "right shard."
        )
    return ShardFile(path=path, manifest=manifest)


def find_shards(target: Path) -> list[ShardFile]:
    """Find all shards of a file in its folder.

    Args:
        target: Path of the complete file.

    Returns:
        The shards in their order.

    Raises:
        FileNotFoundError: If there are no shards, or some are missing.
        ValueError: If a shard is damaged, does not match its file name, or differs from the others
            in the number of shards, the options, the input or the version.
    """
    # `a.v2.00000-of-00002.json` is a shard of `a.v2.json`, and none of `a.json`.
    stem = re.escape(target.stem)
    form = re.compile(rf"{stem}\.\d+-of-\d+{re.escape(target.suffix)}\.manifest", flags=re.ASCII)
    # Wildcards in the name of the file itself have no meaning.
    candidates = target.parent.glob(f"{glob.escape(target.stem)}.*.manifest")
    manifest_paths = sorted(path for path in candidates if form.fullmatch(path.name))
    # `with_suffix` removes `.manifest`, and leaves the path of the shard.
    shards = [read_shard(path.with_suffix("")) for path in manifest_paths]
    if not shards:
        raise FileNotFoundError(f"there are no shards of {target}: --shard I/N makes them.")
    first = shards[0]
    for other in shards[1:]:
        differences = _differences(first=first.manifest, other=other.manifest)
        if differences:
            raise InputError(
                f"{first.path} and {other.path} are shards of different work, which differs in "
                f"{differences}: make the wrong ones again."
            )
    count = first.manifest["of"]
    indices = {shard.manifest["shard"] for shard in shards}
    missing = [str(index) for index in range(count) if index not in indices]
    if missing:
        some = ", ".join(missing[:10])
        if len(missing) > 10:
            some += ", ..."
        raise FileNotFoundError(
            f"{target} lacks {len(missing)} of its {count} shards: {some}; run the command again "
            f"with --shard {missing[0]}/{count}."
        )
    return shards


def _manifest_path(path: Path) -> Path:
    """Path of the manifest of a shard, from the path of the shard."""
    return path.with_name(f"{path.name}.manifest")


def _differences(first: Mapping[str, Any], other: Mapping[str, Any]) -> str:
    """Describe the entries and options in which two manifests differ; empty if there are none."""
    pairs: dict[str, tuple[Any, Any]] = {}
    for name in _SHARED_ENTRIES:
        if name != "options":
            pairs[name] = (first[name], other[name])
    first_options = first["options"]
    other_options = other["options"]
    for name in {**first_options, **other_options}:
        pairs[name] = (first_options.get(name), other_options.get(name))
    differences = []
    for name, (value, other_value) in pairs.items():
        if value != other_value:
            differences.append(f"{name} ({value!r:.80}, {other_value!r:.80})")
    return ", ".join(differences)
