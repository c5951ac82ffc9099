"""Reading of pickles that hold plain data. Nothing that a file names is ever imported or called."""

import pickle
import pickletools
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gsmap.utils.numpy_pickle import CHECKED, CheckedArray, CheckedDtype

_VALUES = frozenset(
    {
        "INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT",
        "STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE",
        "BINUNICODE8", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8",
    }
)  # fmt: skip
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_EMPTY: dict[str, Callable[[], Any]] = {
    "EMPTY_LIST": list, "EMPTY_DICT": dict, "EMPTY_TUPLE": tuple, "EMPTY_SET": set,
}  # fmt: skip
_EMPTY_CALLS: dict[str, Callable[[], Any]] = {
    "collections.OrderedDict": dict, "__builtin__.bytes": bytes, "builtins.bytes": bytes,
}  # fmt: skip
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_KEYS = (str, bytes, int, float, np.generic, type(None))
_CONTAINERS = (list, tuple, dict, set, frozenset)
_MAX_DEPTH = 50
_VALUES_PER_BYTE = 20  # what is shared counts each time


class _Name(NamedTuple):
    """A function or class that a pickle names."""

    path: str


class _Machine:
    """The stack machine of a pickle, for the instructions that plain data needs."""

    def __init__(self) -> None:
        self._stack: list[Any] = []
        self._marks: list[list[Any]] = []
        self._memo: dict[int, Any] = {}
        self._instructions: dict[str, Callable[[Any], None]] = {
            "PROTO": lambda _: None,
            "FRAME": lambda _: None,
            "MARK": self._mark,
            "LIST": lambda _: self._push(self._to_mark()),
            "TUPLE": lambda _: self._push(tuple(self._to_mark())),
            "DICT": lambda _: self._push(_filled({}, self._to_mark())),
            "FROZENSET": lambda _: self._push(frozenset(map(_key, self._to_mark()))),
            "APPEND": lambda _: self._extend([self._stack.pop()]),
            "APPENDS": lambda _: self._extend(self._to_mark()),
            "SETITEM": lambda _: self._set_items([self._stack.pop(-2), self._stack.pop()]),
            "SETITEMS": lambda _: self._set_items(self._to_mark()),
            "ADDITEMS": self._add_items,
            "GLOBAL": lambda name: self._push(_Name(name.replace(" ", "."))),
            "STACK_GLOBAL": self._name,
            "REDUCE": self._call,
            "BUILD": self._set_state,
            "MEMOIZE": lambda _: self._put(len(self._memo)),
            **dict.fromkeys(("PUT", "BINPUT", "LONG_BINPUT"), self._put),
            **dict.fromkeys(("GET", "BINGET", "LONG_BINGET"), lambda i: self._push(self._memo[i])),
        }

    def run(self, content: bytes) -> Any:
        """Return what a pickle holds."""
        for opcode, argument, position in pickletools.genops(content):
            name = opcode.name
            if name in _VALUES:
                self._push(argument)
            elif name in self._instructions:
                self._instructions[name](argument)
            elif name in _CONSTANTS:
                self._push(_CONSTANTS[name])
            elif name in _EMPTY:
                self._push(_EMPTY[name]())
            elif name in _TUPLES:
                parts = [self._stack.pop() for _ in range(_TUPLES[name])]
                self._push(tuple(reversed(parts)))
            elif name != "STOP":
                raise pickle.UnpicklingError(f"it uses the instruction {name}")
            elif position != len(content) - 1:
                raise pickle.UnpicklingError("more follows its end")
        return self._stack.pop()

    def _push(self, value: Any) -> None:
        self._stack.append(value)

    def _mark(self, _: None) -> None:
        self._marks.append(self._stack)
        self._stack = []

    def _to_mark(self) -> list[Any]:
        items, self._stack = self._stack, self._marks.pop()
        return items

    def _top(self, *kinds: type) -> Any:
        if type(self._stack[-1]) not in kinds:
            raise pickle.UnpicklingError(f"it changes a {type(self._stack[-1]).__name__}")
        return self._stack[-1]

    def _extend(self, items: list[Any]) -> None:
        self._top(list).extend(items)

    def _set_items(self, items: list[Any]) -> None:
        _filled(self._top(dict), items)

    def _add_items(self, _: None) -> None:
        items = self._to_mark()
        self._top(set).update(map(_key, items))

    def _put(self, index: int) -> None:
        self._memo[index] = self._stack[-1]

    def _name(self, _: None) -> None:
        name, module = self._stack.pop(), self._stack.pop()
        self._push(_Name(f"{module}.{name}"))

    def _call(self, _: None) -> None:
        """Put what a name stands in for, made with its arguments, onto the stack."""
        arguments, name = self._stack.pop(), self._stack.pop()
        if not isinstance(name, _Name) or not isinstance(arguments, tuple):
            raise pickle.UnpicklingError(f"it calls a {type(name).__name__}")
        if name.path in _EMPTY_CALLS and not arguments:
            self._push(_EMPTY_CALLS[name.path]())
        elif name.path in CHECKED:
            self._push(
                CHECKED[name.path](*(CheckedArray if _is_array(a) else a for a in arguments))
            )
        else:
            raise pickle.UnpicklingError(f"it asks for {name.path}, which is not plain data")

    def _set_state(self, _: None) -> None:
        state = self._stack.pop()
        self._top(CheckedArray, CheckedDtype).__setstate__(state)


def _is_array(argument: Any) -> bool:
    """Whether an argument names numpy's class of arrays."""
    return isinstance(argument, _Name) and argument.path == "numpy.ndarray"


def _key(value: Any) -> Hashable:
    """Return a key of a dict or set, if it is a plain one."""
    parts = value if isinstance(value, tuple) else (value,)
    if not all(isinstance(part, _KEYS) for part in parts):
        raise pickle.UnpicklingError(f"a key is a {type(value).__name__}")
    return value


def _filled(target: dict[Any, Any], items: list[Any]) -> dict[Any, Any]:
    """Put keys and values, which alternate, into a dict."""
    if len(items) % 2:
        raise pickle.UnpicklingError("a key has no value")
    target.update(zip(map(_key, items[::2]), items[1::2], strict=True))
    return target


def _count(value: Any, counts: dict[int, int], depth: int = 0) -> int:
    """Count the values in nested containers; refuse what holds itself or is nested too deep."""
    if isinstance(value, _Name):
        raise pickle.UnpicklingError(f"it asks for {value.path}, which is not plain data")
    if not isinstance(value, _CONTAINERS):
        return 1
    if depth > _MAX_DEPTH or counts.get(id(value)) == 0:
        raise pickle.UnpicklingError("a container holds itself, or they are nested too deep")
    if id(value) not in counts:
        counts[id(value)] = 0  # under way
        inner = value.values() if isinstance(value, dict) else value
        counts[id(value)] = 1 + sum(_count(v, counts, depth + 1) for v in inner)
    return counts[id(value)]


def load_plain_pickle(path: str | Path) -> Any:
    """Read a pickle of plain containers and numpy values.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is not a whole pickle, or asks for anything but plain data.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"There is no file {path}.")
    content = path.read_bytes()
    try:
        value = _Machine().run(content)
        if _count(value, {}) > _VALUES_PER_BYTE * len(content):
            raise pickle.UnpicklingError("it repeats its own parts beyond any use")
    except (pickle.UnpicklingError, LookupError, TypeError, ValueError) as error:
        raise ValueError(
            f"{path} cannot be read as a pickle of plain data: {error}. Nothing of it was run: "
            "fetch it again, or save it anew with lists, dicts and numpy arrays only."
        ) from error
    return value
