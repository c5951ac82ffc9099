"""How a bag lies on the disk: its files, its parts, and what is wrong with them."""

import re
import struct
from collections.abc import Sequence
from pathlib import Path

import yaml

from gsmap.utils.errors import InputError
from gsmap.utils.inputs import heed_input
from mapdata.mcap_bag import MAGIC, McapBag, is_plain_ros2
from mapdata.ros_bag import RosBag

Bag = RosBag | McapBag
SUFFIXES = (".bag", ".mcap", ".db3")
_METADATA = "metadata.yaml"
_MOST_BYTES = 300_000  # of metadata; reading a thousand bytes takes some milliseconds
_ALIAS = re.compile(r"(^|[\s\[{,:-])\*\w", re.MULTILINE)
_PACKED = (".zstd", ".zst", ".lz4", ".gz", ".bz2", ".xz", ".zip", ".tar")
_STARTS = {".mcap": MAGIC, ".db3": b"SQLite format 3\0", ".bag": b"#ROSBAG V2.0"}


def is_bag(path: Path) -> bool:
    """Whether a path is a bag: ``.bag``, ``.mcap``, ``.db3``, or a folder of rosbag2."""
    if path.is_dir():
        return (path / _METADATA).is_file()
    return path.suffix in SUFFIXES


def parts_in(folder: Path) -> list[Path]:
    """Return the files of bags in a folder, in the order of their numbers."""
    found = [
        path
        for path in folder.iterdir()
        if path.suffix in SUFFIXES and path.is_file() and not path.name.startswith(".")
    ]
    return sorted(found, key=lambda path: (_number_of(path), path.name))


def _number_of(path: Path) -> int:
    """Return the number at the end of a part's name."""
    match = re.search(r"_(\d+)$", path.stem)
    return int(match[1]) if match else 0


def bag_at(path: Path) -> Bag:
    """Return the bag at a path, not yet open.

    Args:
        path: A file, a folder of rosbag2, or a folder of the parts of one recording.

    Raises:
        ValueError: If the files of a folder are not the parts of one recording, or it is a pipe.
    """
    if not path.is_dir():
        heed_input(path)
        return _bag_of([path], _notes_on([path]))
    parts = parts_in(path)
    if not (path / _METADATA).is_file():
        _check_parts(parts)
        names = ", ".join(part.name for part in parts)
        note = f"{path.name} has no {_METADATA}: {names} are read as the parts of one recording"
        return _bag_of(parts, [note] * (len(parts) > 1) + _notes_on(parts))
    listed = _listed_parts(path)
    notes = _notes_on(listed)
    if others := [part.name for part in parts if part not in listed]:
        notes.append(
            f"{', '.join(others)} in {path.name} are not read, since {_METADATA} does not name "
            "them: `ros2 bag reindex` lists them"
        )
    if listed and listed[0].suffix == ".mcap" and not all(map(is_plain_ros2, listed)):
        return McapBag(listed, notes)
    return RosBag([path], notes)


def _bag_of(parts: Sequence[Path], notes: list[str]) -> Bag:
    """Return the bag of some files."""
    if parts[0].suffix == ".mcap" and not all(map(is_plain_ros2, parts)):
        return McapBag(parts, notes)
    return RosBag(parts, notes)


def _listed_parts(folder: Path) -> list[Path]:
    """Return the files in a folder that its metadata name."""
    text = _metadata(folder / _METADATA)
    return [
        part
        for part in parts_in(folder)
        if re.search(rf"(?<![\w.-]){re.escape(part.name)}(?![\w.-])", text)
    ]


def _metadata(file: Path) -> str:
    """Return the text of a bag's metadata.

    Raises:
        ValueError: If its values may be far more than its letters: it is too long, or its values
            stand for others (aliases and merge keys of YAML), which rosbag2 does not write.
    """
    if file.stat().st_size > _MOST_BYTES:
        raise InputError(
            f"{file.name} has more than {_MOST_BYTES} bytes: `ros2 bag convert` writes fewer parts"
        )
    text = file.read_text(encoding="utf-8", errors="replace")
    if "<<" in text or _ALIAS.search(text):
        raise InputError(f"{file.name} has aliases of YAML: `ros2 bag reindex` writes it anew")
    return text


def _check_parts(parts: Sequence[Path]) -> None:
    """Raise a ``ValueError`` unless files are the numbered parts of one recording, or one file."""
    patterns = {re.sub(r"\d+", "0", part.name) for part in parts}
    numbers = {_number_of(part) for part in parts}
    if len(parts) > 1 and (len(patterns) > 1 or len(numbers) < len(parts)):
        found = ", ".join(part.name for part in parts)
        raise InputError(f"it holds several bags ({found}): name one of them")


def _notes_on(parts: Sequence[Path]) -> list[str]:
    """Say which files hold messages that are not read."""
    logs = [part.with_name(f"{part.name}-wal") for part in parts if part.suffix == ".db3"]
    return [
        f"{log.name} holds messages that {log.stem}.db3 lacks, and they are not read: "
        f"`sqlite3 {log.stem}.db3 'PRAGMA wal_checkpoint'` adds them"
        for log in logs
        if log.is_file() and log.stat().st_size
    ]


def damage_in(path: Path) -> str | None:
    """Say how the files of a bag are damaged, and how to mend them; None if nothing is found."""
    if not path.is_dir():
        return _damage_of(path)
    file = path / _METADATA
    listed = _listed_names(file) if file.is_file() else []
    if listed is None:
        return f"{_METADATA} is empty or damaged: `ros2 bag reindex {path.name}` writes it anew"
    if missing := [name for name in listed if not (path / name).is_file()]:
        return (
            f"{_METADATA} names {', '.join(missing)}, not there: copy all files of the recording, "
            f"or `ros2 bag reindex {path.name}` to go on with the others"
        )
    found = ((part.name, _damage_of(part)) for part in parts_in(path))
    return next((f"{name}: {damage}" for name, damage in found if damage), None)


def _listed_names(file: Path) -> list[str] | None:
    """Return the names of the files in metadata, or None if they cannot be read."""
    try:
        content = yaml.safe_load(_metadata(file))
        paths = content["rosbag2_bagfile_information"]["relative_file_paths"]
        return [Path(str(path)).name for path in paths]
    except (yaml.YAMLError, UnicodeDecodeError, TypeError, KeyError):
        return None


def _damage_of(path: Path) -> str | None:
    """Say how a bag's file is damaged, and how to mend it."""
    if not path.is_file():
        return "it is a pipe, a socket or a device: give a plain file"
    size = path.stat().st_size
    if not size:
        return "it is empty: the recorder or the copy was stopped before anything was written"
    with path.open("rb") as file:
        start = file.read(4096)
        file.seek(max(size - len(MAGIC), 0))
        end = file.read()
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
        index = re.search(rb"index_pos=(.{8})", start, re.DOTALL)
        position = struct.unpack("<Q", index[1])[0] if index else 0
        if not 0 < position <= size:
            return (
                "it has no index, since the recorder was killed or the copy is cut short: copy it "
                f"again, or `rosbag reindex {path.name}` finds all messages before the cut"
            )
    return None


def _sqlite_size(header: bytes) -> int:
    """Return how many bytes a file of SQLite has by its header."""
    page_size = struct.unpack(">H", header[16:18])[0]
    pages = struct.unpack(">I", header[28:32])[0]
    return (65536 if page_size == 1 else page_size) * pages


def suffix_advice(path: Path) -> str | None:
    """Say what to do with the file of a bag whose suffix is none of ``SUFFIXES``."""
    name, suffixes = path.name, [suffix.lower() for suffix in path.suffixes]
    if suffixes[-2:] == [".bag", ".active"]:
        return f"its recorder was killed: `rosbag reindex {name}`, and rename it to end in .bag"
    if suffixes and suffixes[-1] in _PACKED and set(suffixes) & set(SUFFIXES):
        return f"it is packed ({path.suffix}): unpack it first"
    if suffixes and suffixes[-1] in SUFFIXES:
        return f"rename it: the suffix of a bag is {suffixes[-1]}"
    return None
