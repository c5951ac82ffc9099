"""Files of a bag (a ROS recording): their suffixes, the parts of a recording, and their damage.

A recording is one file, or a folder with several files, its parts. The recorder of ROS 2 (rosbag2)
also writes ``metadata.yaml`` to the folder, which lists the parts. Notes are remarks for the user.
"""

import re
import struct
from collections.abc import Sequence
from pathlib import Path

import yaml

from gsmap.utils.errors import InputError
from gsmap.utils.inputs import check_input
from mapdata.mcap_bag import MAGIC, McapBag, is_plain_ros2
from mapdata.ros_bag import RosBag

# `RosBag` reads all kinds of bags by the package rosbags. `McapBag` reads MCAP files with messages
# that rosbags does not know.
Bag = RosBag | McapBag
SUFFIXES = (".bag", ".mcap", ".db3")
_METADATA = "metadata.yaml"
_MOST_BYTES = 300_000  # largest metadata; parsing a thousand bytes of YAML takes milliseconds
_ALIAS = re.compile(r"(^|[\s\[{,:-])\*\w", flags=re.MULTILINE)  # alias of YAML, such as *name
# Suffixes of compressed files and archives.
_PACKED = (".zstd", ".zst", ".lz4", ".gz", ".bz2", ".xz", ".zip", ".tar")
# First bytes of a file, by its suffix.
_STARTS = {".mcap": MAGIC, ".db3": b"SQLite format 3\0", ".bag": b"#ROSBAG V2.0"}


def is_bag(path: Path) -> bool:
    """Whether a path is a bag: ``.bag``, ``.mcap``, ``.db3``, or a folder of rosbag2."""
    if path.is_dir():
        return (path / _METADATA).is_file()
    return path.suffix in SUFFIXES


def parts_in(folder: Path) -> list[Path]:
    """Files of bags in a folder, in the order of their numbers; hidden files are left out."""
    parts = []
    for path in folder.iterdir():
        is_hidden = path.name.startswith(".")
        if path.suffix in SUFFIXES and path.is_file() and not is_hidden:
            parts.append(path)
    return sorted(parts, key=lambda path: (_part_number(path), path.name))


def _part_number(path: Path) -> int:
    """Number at the end of a file's name, such as 3 of ``drive_3.mcap``; 0 without a number."""
    match = re.search(r"_(\d+)$", path.stem)
    return int(match[1]) if match else 0


def bag_at(path: Path) -> Bag:
    """Find the bag at a path, without opening it.

    Args:
        path: A file, a folder of rosbag2, or a folder with the parts of one recording.

    Returns:
        The bag, with notes on files that are not read.

    Raises:
        ValueError: If a folder without metadata holds several recordings, the path is a pipe or a
            device, an MCAP file is damaged, or the metadata are too long or have aliases of YAML.
    """
    if not path.is_dir():
        check_input(path)  # an error for a pipe, a device or an output of the command
        return _bag_of([path], notes=_notes_on([path]))
    parts = parts_in(path)
    if not (path / _METADATA).is_file():
        _check_parts(parts)
        notes = []
        if len(parts) > 1:
            names = ", ".join(part.name for part in parts)
            notes.append(
                f"{path.name} has no {_METADATA}: {names} are read as the parts of one recording"
            )
        return _bag_of(parts, notes=notes + _notes_on(parts))
    listed_parts = _listed_parts(path)
    notes = _notes_on(listed_parts)
    unlisted = [part.name for part in parts if part not in listed_parts]
    if unlisted:
        notes.append(
            f"{', '.join(unlisted)} in {path.name} are not read, since {_METADATA} does not name "
            "them: `ros2 bag reindex` lists them"
        )
    if listed_parts and _needs_mcap_reader(listed_parts):
        return McapBag(listed_parts, notes=notes)
    return RosBag([path], notes=notes)  # rosbags reads the metadata of the folder itself


def _bag_of(parts: Sequence[Path], notes: list[str]) -> Bag:
    """Create the bag of the parts of one recording; there must be at least one."""
    if _needs_mcap_reader(parts):
        return McapBag(parts, notes=notes)
    return RosBag(parts, notes=notes)


def _needs_mcap_reader(parts: Sequence[Path]) -> bool:
    """Whether files are MCAP files, at least one of which the package rosbags cannot read.

    The files of one recording have one suffix, so the first file decides.
    """
    # `is_plain_ros2` is True for a file with messages of ROS 2 only, which rosbags can read.
    return parts[0].suffix == ".mcap" and not all(map(is_plain_ros2, parts))


def _listed_parts(folder: Path) -> list[Path]:
    """Files in a folder that are named in the metadata of the folder."""
    text = _read_metadata(folder / _METADATA)
    listed_parts = []
    for part in parts_in(folder):
        # The text is searched and not parsed, since it may be damaged (`damage_in` reports that).
        # The name must not be a part of a longer name.
        if re.search(rf"(?<![\w.-]){re.escape(part.name)}(?![\w.-])", text):
            listed_parts.append(part)
    return listed_parts


def _read_metadata(file: Path) -> str:
    """Read the text of a bag's metadata.

    Raises:
        ValueError: If parsing could take much more memory than the text: the text is too long, or
            has aliases or merge keys of YAML, which rosbag2 does not write.
    """
    if file.stat().st_size > _MOST_BYTES:
        raise InputError(
            f"{file.name} has more than {_MOST_BYTES} bytes, such as for a recording of thousands "
            "of parts: `ros2 bag convert` can write the recording in fewer parts"
        )
    text = file.read_text(encoding="utf-8", errors="replace")
    if "<<" in text or _ALIAS.search(text):
        raise InputError(f"{file.name} has aliases of YAML: `ros2 bag reindex` writes it anew")
    return text


def _check_parts(parts: Sequence[Path]) -> None:
    """Raise a ``ValueError`` unless files are one file, or the numbered parts of one recording."""
    # Files are parts of one recording if their names differ only in digits, and if the numbers at
    # the ends of their names all differ.
    patterns = set()
    numbers = set()
    for part in parts:
        patterns.add(re.sub(r"\d+", repl="0", string=part.name))
        numbers.add(_part_number(part))
    are_numbered = len(patterns) == 1 and len(numbers) == len(parts)
    if len(parts) > 1 and not are_numbered:
        names = ", ".join(part.name for part in parts)
        raise InputError(f"it holds several bags ({names}): name one of them")


def _notes_on(parts: Sequence[Path]) -> list[str]:
    """Notes on write-ahead logs of SQLite, whose messages are not read."""
    notes = []
    for part in parts:
        if part.suffix != ".db3":
            continue
        log = part.with_name(f"{part.name}-wal")
        if log.is_file() and log.stat().st_size:
            notes.append(
                f"{log.name} holds messages that {part.name} lacks, and they are not read: "
                f"`sqlite3 {part.name} 'PRAGMA wal_checkpoint'` adds them"
            )
    return notes


def damage_in(path: Path) -> str | None:
    """Describe the first damage of a bag's files and its remedy; None if no damage is found."""
    if not path.is_dir():
        return _damage_of(path)
    metadata = path / _METADATA
    names = _listed_names(metadata) if metadata.is_file() else []
    if names is None:
        return f"{_METADATA} is empty or damaged: `ros2 bag reindex {path.name}` writes it anew"
    missing = [name for name in names if not (path / name).is_file()]
    if missing:
        return (
            f"{_METADATA} names {', '.join(missing)}, which {path.name} does not contain: copy all "
            f"files of the recording, or run `ros2 bag reindex {path.name}` to use only the others"
        )
    for part in parts_in(path):
        damage = _damage_of(part)
        if damage:
            return f"{part.name}: {damage}"
    return None


def _listed_names(file: Path) -> list[str] | None:
    """Names of the files that metadata list; None if the metadata cannot be parsed."""
    try:
        content = yaml.safe_load(_read_metadata(file))
        paths = content["rosbag2_bagfile_information"]["relative_file_paths"]
        return [Path(str(path)).name for path in paths]
    except (yaml.YAMLError, TypeError, KeyError):
        return None


def _damage_of(path: Path) -> str | None:
    """Describe the damage of one file and its remedy; None if no damage is found.

    The file must have one of ``SUFFIXES``.
    """
    if not path.is_file():
        return "it is a pipe, a socket or a device: give a plain file"
    size = path.stat().st_size
    if not size:
        return "it is empty: the recorder or the copy was stopped before anything was written"
    with path.open("rb") as file:
        start = file.read(4096)
        file.seek(max(size - len(MAGIC), 0))
        end = file.read()  # a complete MCAP file also ends with `MAGIC`
    if not start.startswith(_STARTS[path.suffix]):
        return (
            f"it begins with {start[:12]!r} and is no {path.suffix} file: is it a pointer of git "
            "lfs, a page of the web, or a bag older than ROSBAG V2.0?"
        )
    if path.suffix == ".mcap" and end != MAGIC:
        return (
            "it has no end, since the recorder was killed or the copy is cut short: copy it again, "
            f"or `mcap recover {path.name} -o whole.mcap` keeps all messages before the cut"
        )
    if path.suffix == ".db3" and size < _sqlite_size(start):
        return (
            f"it is cut short: copy it again, or `sqlite3 {path.name} .recover | sqlite3 whole.db3`"
            " keeps what is readable"
        )
    if path.suffix == ".bag":
        # The header contains the position of the index, which is 0 until the recorder ends.
        index = re.search(rb"index_pos=(.{8})", start, flags=re.DOTALL)
        # The position is an unsigned integer of 8 bytes, little-endian.
        position = struct.unpack("<Q", index[1])[0] if index else 0
        if not 0 < position <= size:
            return (
                "it has no index, since the recorder was killed or the copy is cut short: copy it "
                f"again, or `rosbag reindex {path.name}` finds all messages before the cut"
            )
    return None


def _sqlite_size(header: bytes) -> int:
    """Size of an SQLite file in bytes, according to its header.

    The header has big-endian integers: the size of a page, and the number of pages.
    """
    page_size = struct.unpack(">H", header[16:18])[0]
    if page_size == 1:
        page_size = 65536  # too large for the two bytes, so SQLite writes 1
    page_count = struct.unpack(">I", header[28:32])[0]
    return page_size * page_count


def suffix_advice(path: Path) -> str | None:
    """Advice on a file that is probably a bag without one of ``SUFFIXES``; None for other files."""
    name = path.name
    suffixes = [suffix.lower() for suffix in path.suffixes]
    if suffixes[-2:] == [".bag", ".active"]:
        return f"its recorder was killed: `rosbag reindex {name}`, and rename it to end in .bag"
    # A packed bag has two suffixes, such as .bag.gz.
    if suffixes and suffixes[-1] in _PACKED and set(suffixes) & set(SUFFIXES):
        return f"it is packed ({path.suffix}): unpack it first"
    if suffixes and suffixes[-1] in SUFFIXES:  # in capital letters, such as .BAG
        return f"rename it: the suffix of a bag is {suffixes[-1]}"
    return None
