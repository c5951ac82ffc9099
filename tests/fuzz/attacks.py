"""Files that would do something when they are read: harmless stand-ins that leave a marker.

``python attacks.py READER FOLDER`` reads those of a folder in a process of its own.
"""

import copy
import json
import os
import pickle
import struct
import sys
from collections import OrderedDict
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np

MARKER = "marker"
PLANTED = "planted"  # a module of the folder, which leaves the marker when it is imported
CONFIG = Path(__file__).resolve().parents[2] / "configs/maptr/maptr_r18_minicity.py"


class Calls:
    """Pickles as a call of a function."""

    def __init__(self, function: Any, *arguments: Any, state: Any = None) -> None:
        self.parts = (function, arguments, state) if state is not None else (function, arguments)

    def __reduce__(self) -> tuple[Any, ...]:
        return self.parts


def _named(module: str, name: str) -> bytes:
    """Return the instruction that looks up a name."""
    return b"c" + f"{module}\n{name}\n".encode()


def _plain(value: Any) -> bytes:
    """Return the instructions that make a plain value, as torch's reader knows them too."""
    return pickle.dumps(value, 2)[2:-1]


def _dtype(code: str, state: Any) -> bytes:
    """Return a dtype with a state of its own."""
    made = _named("numpy", "dtype") + _plain((code, False, True)) + b"R"
    return made + _plain(state) + b"b"


def _array(dtype: bytes, shape: tuple[int, ...], data: bytes) -> bytes:
    """Return an array with a dtype that is given as instructions."""
    empty = _named("numpy.core.multiarray", "_reconstruct") + b"(" + _named("numpy", "ndarray")
    state = b"(K\x01" + _plain(shape) + dtype + b"\x89" + _plain(data) + b"tb"
    return empty + _plain((0,)) + _plain(b"b") + b"tR" + state


def _whole(body: bytes) -> bytes:
    return b"\x80\x04" + body + b"."


def corpus(folder: Path) -> dict[str, bytes]:
    """Return the attacks by name; the marker of one that succeeds lies in ``folder``."""
    marker = str(folder / MARKER)
    touch = f"open({marker!r}, 'w').close()"
    pointer = struct.pack("<Q", id(marker))
    object_state = (3, "|", None, None, None, 8, 8, 63)
    fields = (3, "|", None, ("a",), {"a": (np.dtype("O"), 0)}, 8, 8, 63)
    numbers = (3, "<", None, None, None, -1, -1, 0)
    calls = {
        "open": Calls(open, marker, "w"),
        "system": Calls(os.system, f"touch {marker}"),
        "exec": Calls(exec, touch),
        "eval": Calls(eval, touch),
        "getattr": Calls(getattr, np.ndarray, "tofile"),
        "import": Calls(__import__, "this"),
        "makedirs": Calls(os.makedirs, marker),
        "nested": {"infos": [{"cams": {"a": Calls(open, marker, "w")}}]},
        "key": {("a", 1): Calls(open, marker, "w")},
        "mapped by numpy": Calls(np.memmap, marker, "u1", "w+", 0, (8,)),
        "saved by numpy": Calls(np.save, marker, np.zeros(1)),
        "tofile": Calls(np.ndarray.tofile, np.zeros(2), marker),
        "object array": np.array([Calls(open, marker, "w")], dtype=object),
        "record": np.zeros(2, dtype=[("a", "f8"), ("b", "O")]),
        "ordered": OrderedDict(a=Calls(open, marker, "w")),
        "state of a dict": Calls(
            OrderedDict, state=(None, {"__class__": Calls(open, marker, "w")})
        ),
    }
    found = {name: pickle.dumps(value, protocol=2) for name, value in calls.items()}
    raw = {
        "dtype of objects": _dtype("O8", (3, "|", None, None, None, -1, -1, 63)),
        "state of objects": _dtype("i8", object_state),
        "fields of objects": _dtype("V8", fields),
        "pointer as an object": _array(_dtype("i8", object_state), (1,), pointer),
        "objects by their code": _array(
            _named("numpy", "dtype") + _plain(("O",)) + b"R", (1,), pointer
        ),
        "size beyond the data": _array(_dtype("i8", numbers), (1 << 40,), pointer),
        "negative size": _array(_dtype("i8", numbers), (-1,), pointer),
        "wide items": _dtype("i8", (3, "<", None, None, None, 1 << 40, 8, 0)),
        "array over bytes": _named("numpy", "ndarray")
        + _plain(((1,), "O", pointer)) + b"R",
        "array as a new object": _named("numpy", "ndarray")
        + _plain(((1,), "O", pointer)) + b"\x81",
        "array of another class": _named("numpy.core.multiarray", "_reconstruct")
        + _named("numpy", "memmap") + _plain((0,)) + _plain(b"b") + b"\x87R",
        "codec": _named("_codecs", "encode") + _plain(("a", "os.sys")) + b"R",
        "function changed": _named("numpy.core.multiarray", "scalar")
        + _plain((None, {"__defaults__": (1,)})) + b"b",
        "stack by name": b"\x8c\x02os\x8c\x06system\x93\x8c" + bytes([len(f"touch {marker}")])
        + f"touch {marker}".encode() + b"\x85R",
        "instance": b"(" + f"S'touch {marker}'\nios\nsystem\n".encode(),
        "object": b"(" + _named("os", "system") + f"S'touch {marker}'\n".encode() + b"o",
        "persistent": b"Vos.system\nQ",
        "extension": b"\x82\x01",
        "huge memo": b"]r\xff\xff\xff\x7f",
        "huge text": b"\x8d" + b"\xff" * 7 + b"\x7f",
        "deep key": b")" + b"\x85" * 200_000 + b"}\x8c\x01as" ,
        "holds itself": b"]\x94h\x00a",
        "doubling": b"]\x94" + b"".join(
            b"](h%ch%ce\x94" % (i, i) for i in range(40)
        ),
    }  # fmt: skip
    return found | {name: _whole(body) for name, body in raw.items()}


def plant(folder: Path) -> str:
    """Write the module, and return the name of its marker."""
    marker = str(folder / MARKER)
    (folder / f"{PLANTED}.py").write_text(f"open({marker!r}, 'w').close()\nprint(end='')\n")
    return marker


def settings_corpus(folder: Path, settings: dict[str, Any]) -> dict[str, Any]:
    """Return model settings that a checkpoint may hold, by what they try; writes the module."""
    marker = plant(folder)
    make = {"type": "os.makedirs", "name": marker}
    head = settings["map_head"]
    tried: dict[str, dict[str, Any]] = {  # img_augment is not used when a model is tested
        "open": {"img_augment": {"type": "builtins.open", "file": marker, "mode": "w"}},
        "popen": {"img_augment": {"type": "subprocess.Popen", "args": ["touch", marker]}},
        "makedirs": {"img_augment": make},
        "module": {"img_augment": {"type": PLANTED}},
        "attribute of a module": {"img_augment": {"type": f"{PLANTED}.print"}},
        "module behind a scope": {"img_augment": {"type": f"mmdet.{PLANTED}"}},
        "scope": {"img_augment": {"type": "GridMask", "_scope_": PLANTED}},
        "in a list": {"map_head": {**head, "losses": [*head["losses"], make]}},
        "among costs": {"map_head": {**head, "match_costs": [*head["match_costs"], make]}},
        "text that a class runs": {"map_head": {**head, "match_costs": [
            {"type": "mmdet.CameraMotionCompensation", "warp_mode": f"open({marker!r}, 'w')"}]}},
        "in a list of a part": {"data_preprocessor": {
            **settings["data_preprocessor"], "batch_augments": [make]}},
        "layer": {"img_backbone": {**settings["img_backbone"], "norm_cfg": {"type": PLANTED}}},
        "layer of a part": {"img_neck": {**settings["img_neck"], "norm_cfg": {"type": PLANTED}}},
        "model": {"type": "os.makedirs"},
        "type of several": {"img_augment": {"type": ["os.makedirs"], "name": marker}},
        "address": {"img_augment": {"type": "GridMask", "prob": "https://localhost/x"}},
        "hidden key": {"__class__": make},
        "unknown key": {"img_augments": {"type": "GridMask"}},
        "endless": {"map_head": {**head, "num_points": 2**70}},
        "no number": {"map_head": {**head, "num_points": float("nan")}},
        "deep": {"img_augment": json.loads("[" * 300 + "]" * 300)},
    }  # fmt: skip
    found: dict[str, Any] = {name: {**settings, **change} for name, change in tried.items()}
    found["model"] = {"type": "os.makedirs", "name": marker}
    return {**found, "no settings": [make], "text": f"{PLANTED}.print"}


def config_corpus(folder: Path, text: str) -> dict[str, str]:
    """Return configs of another repository, whose text is given, by what they try."""
    marker = str(folder / MARKER)
    call = f"open({marker!r}, 'w')"
    parts = {
        "key that ends itself": {f"x': {call}, 'y": 1},
        "key that ends its argument": {f"depth=1), z={call}, y=dict(x": 1},
        "key that mmengine heeds": {"_scope_": PLANTED},
        "number as a key": {1: 2},
        "replaced by mmengine": {"x": "\"{{$NOPE:b'}}", "y": f",{call},"},
        "layer of a module": {"conv_cfg": {"type": "os.system"}},
        "type of a module": {"type": "os.makedirs"},
        "bytes": {"x": b"1"},
        "infinite": {"x": "INFINITE"},
        "deep name": {".".join("x" * 3000): 1},
    }
    inner = "type='ResNet', depth=50,"
    tried = {
        name: text.replace(inner, f"**{{**dict({inner}), **{part!r}}},")
        for name, part in parts.items()
    }
    tried["infinite"] = tried["infinite"].replace("'INFINITE'", "1e999")
    lines = {
        "doubling": "a = [0]\n" + "a = a + a\n" * 60,
        "doubling text": "a = 'x'\n" + "a = a + a\n" * 60,
        "lists of lists": "a = 1\n" + "a = [a, a]\n" * 60,
        "squares": "a = 10\n" + "a = a * a\n" * 60,
        "deeper and deeper": "a = 1\n" + "a = [a]\n" * 600,
        "deep signs": "a = " + "-" * 900 + "1\n",
        "endless signs": "a = " + "-" * 90_000 + "1\n",
        "deep brackets": "a = " + "[" * 3000 + "\n",
        "zero byte": "a = 1\0\n",
    }
    return tried | {name: line + text for name, line in lines.items()}


def _convert_config(path: Path) -> None:
    from mmengine.config import Config

    sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
    from tools.convert_config import convert

    target = path.with_suffix(".py")
    convert(path, target)
    Config.fromfile(target, import_custom_modules=False)


def _read_settings(path: Path) -> None:
    from gsmap.apis.map_inferencer import MapInferencer

    sys.path.insert(0, str(path.parent))  # as the working folder may be
    MapInferencer(CONFIG, path, device="cpu")


def _build_settings(path: Path) -> None:
    import torch
    from mmdet3d.registry import MODELS

    from gsmap.checkpoints.settings import MODEL_SETTINGS
    from gsmap.engine.launch import read_config

    sys.path.insert(0, str(path.parent))
    read_config(CONFIG)
    sys.modules.pop(PLANTED, None)  # to be imported by each file anew
    settings = json.loads(torch.load(path, weights_only=True)["meta"][MODEL_SETTINGS])
    MODELS.build(copy.deepcopy(settings))


def _read_plain(path: Path) -> None:
    from mapdata.infos.plain_pickle import load_plain_pickle

    load_plain_pickle(path)


def _read_infos(path: Path) -> None:
    from mapdata.infos.convert import convert_infos

    convert_infos(path, path.with_suffix(".arrow"), path.parent, "val")


def _read_sample(path: Path) -> None:
    from mapdata.infos.recordings import read_info_file

    read_info_file(path)


def _read_weights(path: Path) -> None:
    from gsmap.checkpoints.reading import read_weights

    read_weights(path)


def _read_as_python_does(path: Path) -> None:
    pickle.loads(path.read_bytes())


READERS: dict[str, Callable[[Path], None]] = {
    "plain": _read_plain,
    "infos": _read_infos,
    "sample": _read_sample,
    "weights": _read_weights,
    "config": _convert_config,
    "settings": _read_settings,
    "settings as mmengine builds them": _build_settings,
    "python": _read_as_python_does,
}


def main() -> None:
    """Read every file of a folder, and say how each ended and whether it left the marker."""
    reader, folder = READERS[sys.argv[1]], Path(sys.argv[2])
    for path in sorted(folder.glob("*.pkl")):
        print(path.stem, end=": ", flush=True)  # the last line names the one that crashes
        try:
            with redirect_stdout(sys.stderr):  # mmengine's log
                reader(path)
        except Exception as error:
            outcome = f"{type(error).__name__}: {error}"
        else:
            outcome = "read"
        marker = folder / MARKER
        ran = marker.exists()
        if marker.is_dir():
            marker.rmdir()
        marker.unlink(missing_ok=True)
        print("RAN" if ran else "did not run,", " ".join(outcome.split())[:200], flush=True)


if __name__ == "__main__":
    main()
