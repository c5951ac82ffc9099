"""Ways to damage a file: its bytes, or the values that it holds."""

import copy
import io
import json
import math
import pickle
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from random import Random
from typing import Any

import pyarrow as pa
import torch
import yaml

from gsmap.checkpoints.settings import MODEL_SETTINGS
from gsmap.datasets.annotations.schema import FIELDS

ODD = (
    None, True, "", "x", "../x", "/etc/x", "1.0", -1, 0, 99, 2**40, 2**70, 1e308, -1e-9, math.nan,
    math.inf, [], {}, [1, 2], [[0.0] * 4] * 4, {"token": "x"},
)  # fmt: skip
HOSTILE = (
    "/", "..", "../", "/../", "../../", "a/../../", "//", "/etc/x", "\\", ".", "~/", "\0", "\n",
    "\x1b[2J", "$(id)", "%2e%2e/", "\u202e", "-rf ", "con:", "';", '"',
)  # fmt: skip
_BOMB = "a: &a [0]\n" + "".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]\n"
    for before, name in pairwise("abcdefghijklmn")
)

# each ends the process, should it run
HOSTILE_SETTINGS = (
    {"type": "os.abort"}, [{"type": "os.abort"}], {"type": "mmdet.os.abort"}, {"type": "abort"},
    {"type": "GridMask", "_scope_": "antigravity"}, {"type": ["os.abort"]}, "os.abort",
    {"type": "mmdet.CameraMotionCompensation", "warp_mode": "__import__('os').abort()"},
    {"x': __import__('os').abort(), 'y": 1}, {"x=__import__('os').abort(), y": 1},
    {"x": "\"{{$NOPE:b'}}", "y": ",__import__('os').abort(),"},
)  # fmt: skip
GROWING = (
    "x = [0]\n" + "x = x + x\n" * 60, "x = 9\n" + "x = x * x\n" * 60, "x = 1\n" + "x = [x]\n" * 600,
    "x = " + "-" * 9000 + "1\n", "x = " + "(" * 900 + "1" + ")" * 900 + "\n",
)  # fmt: skip


def damaged_bytes(content: bytes, rng: Random) -> bytes:
    """Flip, cut, repeat, swap, blank or insert bytes."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 8))):
        start = rng.randrange(len(data) or 1)
        length = min(rng.choice((1, 2, 4, 8, 64, 512)), len(data) - start)
        other = rng.randrange(len(data) - length or 1)
        kind = rng.randrange(8)
        if kind <= 1 and data:
            data[start] ^= 1 << rng.randrange(8)
        elif kind == 2:
            data[start : start + length] = rng.randbytes(length)
        elif kind == 3:
            data[start : start + length] = rng.choice((b"\0", b"\xff")) * length
        elif kind == 4:
            block = data[start : start + length]
            data[start : start + length] = data[other : other + length]
            data[other : other + length] = block
        elif kind == 5:
            data[start:start] = data[other : other + length]
        elif kind == 6:
            del data[start : start + length]
        else:
            del data[start:]
    return bytes(data)


def damaged_value(value: Any, rng: Random, odd: Sequence[Any] = ODD) -> Any:
    """Return a copy with one part, somewhere inside, replaced, dropped, repeated or scaled."""
    value = copy.deepcopy(value)
    holder, place = [value], 0
    top = holder
    while isinstance(holder[place], (dict, list)) and holder[place] and rng.random() < 0.9:
        holder = holder[place]
        place = rng.choice(list(holder) if isinstance(holder, dict) else range(len(holder)))
    found = holder[place]
    kind = rng.randrange(6)
    if kind == 0 and holder is not top:
        del holder[place]
    elif kind == 1 and isinstance(holder, list) and holder is not top:
        holder.insert(place, copy.deepcopy(found))
    elif kind == 2 and isinstance(found, (int, float)) and not isinstance(found, bool):
        holder[place] = found * rng.choice((-1, 1e-3, 1e3, 1e300))
    elif kind == 3 and len(holder) > 1:
        other = rng.choice(list(holder) if isinstance(holder, dict) else range(len(holder)))
        holder[place], holder[other] = holder[other], holder[place]
    else:
        holder[place] = rng.choice(odd)
    return top[0]


def damaged_json(content: bytes, rng: Random) -> bytes:
    """Damage a value of a JSON file, or its text."""
    if rng.random() < 0.3:
        signs = (b",,", b"}", b"]", b"NaN", b"[" * 3000, b" x", b"-", b'"')
        place = rng.randrange(len(content) + 1)
        return content[:place] + rng.choice(signs) + content[place:]
    return json.dumps(damaged_value(json.loads(content), rng)).encode()


def damaged_yaml(content: bytes, rng: Random) -> bytes:
    """Damage a value of a YAML file, or its text."""
    if rng.random() < 0.5:
        signs = (
            "\t", ":", "- ", "{", "[", "*a ", "&a ", "!!python/object/apply:os.system [x]", "? ",
            "%", "'", "|", "<<: ", "\n ", "#", "\0", "@", "!!binary ", "1:1:1:", "[" * 3000, _BOMB,
        )  # fmt: skip
        text = content.decode()
        place = rng.choice((0, rng.randrange(len(text) + 1)))
        return (text[:place] + rng.choice(signs) + text[place:]).encode()
    return yaml.safe_dump(damaged_value(yaml.safe_load(content), rng), sort_keys=False).encode()


def renamed(name: str) -> Callable[[bytes, Random], bytes]:
    """Return what gives a name that stands in a file another, hostile one of the same length."""

    def damage(content: bytes, rng: Random) -> bytes:
        new = b""
        while len(new) < len(name):
            new += rng.choice((rng.choice(HOSTILE), rng.choice(name))).encode()
        if rng.random() < 0.5:
            new = new[::-1]
        return content.replace(name.encode(), new[: len(name)])

    return damage


def damaged_pickle(content: bytes, rng: Random) -> bytes:
    """Damage a value of a pickle."""
    return pickle.dumps(damaged_value(pickle.loads(content), rng), rng.choice((2, 4, 5)))


def damaged_column(name: str) -> Callable[[bytes, Random], bytes]:
    """Return what gives the texts in a column of an annotation file hostile values."""

    def damage(content: bytes, rng: Random) -> bytes:
        count = rng.choice((1, 1, 2, 30))
        text = "".join(rng.choice((*HOSTILE, "a", "../x")) for _ in range(count))
        rows, schema = _rows_of(content)
        return _file_of([{**row, name: text} for row in rows], schema)

    return damage


def _rows_of(content: bytes) -> tuple[list[dict[str, Any]], pa.Schema]:
    reader = pa.ipc.open_file(content)
    batches = (reader.get_batch(i) for i in range(reader.num_record_batches))
    return [row for batch in batches for row in batch.to_pylist()], reader.schema


def _file_of(rows: list[dict[str, Any]], schema: pa.Schema) -> bytes:
    """Return an annotation file without a checksum."""
    columns = [pa.array([row[name] for row in rows], kind) for name, kind in FIELDS.items()]
    sink = pa.BufferOutputStream()
    with pa.ipc.new_file(sink, schema) as writer:
        writer.write_batch(pa.record_batch(columns, schema=schema))
    return sink.getvalue().to_pybytes()


def damaged_metadata(content: bytes, rng: Random) -> bytes:
    """Damage what an exported model says of itself."""
    import onnx

    model = onnx.load_from_string(content)
    text = model.metadata_props[0].value.encode()
    model.metadata_props[0].value = damaged_json(text, rng).decode()
    return model.SerializeToString()


def damaged_rows(content: bytes, rng: Random) -> bytes:
    """Damage a value of an annotation file, without its checksum."""
    rows, schema = _rows_of(content)
    while True:
        damaged = rows
        for _ in range(rng.choice((1, 1, 3))):
            damaged = damaged_value(damaged, rng)
        try:
            return _file_of(damaged, schema)
        except (pa.ArrowException, OverflowError, TypeError, KeyError):
            continue  # Arrow itself does not write this


def damaged_settings(content: bytes, rng: Random) -> bytes:
    """Damage a value, or the text, of the model settings in a checkpoint, or make it hostile."""
    checkpoint = torch.load(io.BytesIO(content), weights_only=True)
    text = checkpoint["meta"][MODEL_SETTINGS]
    if rng.random() < 0.5:
        text = damaged_json(text.encode(), rng).decode()
    else:
        text = json.dumps(damaged_value(json.loads(text), rng, HOSTILE_SETTINGS))
    checkpoint["meta"][MODEL_SETTINGS] = text
    torch.save(checkpoint, file := io.BytesIO())
    return file.getvalue()


def damaged_source(content: bytes, rng: Random) -> bytes:
    """Put hostile settings, or values that grow, into a config of assignments."""
    if rng.random() < 0.3:
        return rng.choice(GROWING).encode() + content
    calls = [at for at in range(len(content)) if content.startswith(b"dict(", at)]
    place = rng.choice(calls) + len(b"dict(")
    hostile = rng.choice([part for part in HOSTILE_SETTINGS if isinstance(part, dict)])
    word = rng.choice((f"**{hostile!r},", f"more={hostile!r},", f"**{{'more': {hostile!r}}},"))
    return content[:place] + word.encode() + content[place:]


def write(path: Path, content: bytes) -> None:
    """Write a file anew, so that one that is mapped into memory keeps what it had."""
    path.unlink(missing_ok=True)
    path.write_bytes(content)
