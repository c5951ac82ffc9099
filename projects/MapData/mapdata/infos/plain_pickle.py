"""Reader of pickles of plain data. It never imports or calls a function that a file names."""

import pickle
import struct
from collections.abc import Callable, Hashable, Iterable
from io import BytesIO
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from gsmap.utils.errors import InputError
from gsmap.utils.numpy_pickle import CHECKED, CheckedArray, CheckedDtype

# Substitutes of functions and classes, by their name in a pickle. `CHECKED` has the substitutes of
# numpy's functions, which check their arguments. The other substitutes take no arguments, so they
# can only create empty values.
_STAND_INS: dict[str, Callable[..., Any]] = {
    **CHECKED,
    "collections.OrderedDict": lambda: {},
    "__builtin__.bytes": lambda: b"",
    "builtins.bytes": lambda: b"",
}
# Keys of dicts and elements of sets are single values of these types, or tuples of them.
_KEYS = (str, bytes, int, float, np.generic, type(None))
_KEY_BITS = 60  # limit of the bits of an integer in a key
_KEY_PARTS = 8  # limit of the length of a tuple as key
_CONTAINERS = (list, tuple, dict, set, frozenset)
_MAX_DEPTH = 50
# Limit of the number of values, per byte of the file. A value counts once for each container that
# holds it. A small file can therefore not describe a huge structure by repeated references.
_VALUES_PER_BYTE = 20
# Errors that the unpickler raises for a damaged or malicious file.
_DAMAGE = (
    pickle.UnpicklingError, EOFError, struct.error, LookupError, TypeError, ValueError,
    AttributeError, ArithmeticError,
)  # fmt: skip


class _PlainUnpickler(pickle._Unpickler):
    """Unpickler of the standard library (its Python version) without the opcodes that make objects.

    Functions and classes are replaced by harmless substitutes. Two opcodes that rebuild objects
    remain, because numpy's arrays need them. ``REDUCE`` calls a function, which can only be a
    substitute here. ``BUILD`` sets a state, here only of the substitutes of numpy.

    Most methods below implement an opcode. They check the types of the values on the stack, which a
    malicious file could choose.
    """

    # Attributes of the base class, declared for the type checker.
    stack: list[Any]
    append: Callable[[Any], None]
    pop_mark: Callable[[], list[Any]]
    read: Callable[[int], bytes]

    def find_class(self, module: str, name: str) -> Callable[..., Any]:
        """Look up the harmless substitute of a function or class.

        Raises:
            UnpicklingError: If there is no substitute.
        """
        path = f"{module}.{name}"
        if path not in _STAND_INS:
            raise pickle.UnpicklingError(f"it asks for {path}, which is not plain data")
        return _STAND_INS[path]

    def _top(self, *kinds: type) -> Any:
        """Value on top of the stack; ``UnpicklingError`` if its type is not one of ``kinds``."""
        if type(self.stack[-1]) not in kinds:
            kind = type(self.stack[-1]).__name__
            raise pickle.UnpicklingError(f"it adds content to a {kind}, which cannot have it")
        return self.stack[-1]

    def _set_state(self) -> None:
        """Set the state of an array or dtype, which checks the state (opcode ``BUILD``)."""
        state = self.stack.pop()
        self._top(CheckedArray, CheckedDtype).__setstate__(state)

    def _set_item(self) -> None:
        """Add the key and the value on top of the stack to a dict (opcode ``SETITEM``)."""
        value = self.stack.pop()
        key = self.stack.pop()
        _fill(self._top(dict), [key, value])

    def _set_items(self) -> None:
        """Add all keys and values since the last mark to a dict (opcode ``SETITEMS``)."""
        items = self.pop_mark()
        _fill(self._top(dict), items)

    def _add_items(self) -> None:
        """Add all values since the last mark to a set (opcode ``ADDITEMS``)."""
        items = self.pop_mark()
        self._top(set).update(map(_key, items))

    def _make_dict(self) -> None:
        """Create a dict from all keys and values since the last mark (opcode ``DICT``)."""
        items = self.pop_mark()
        self.append({})
        _fill(self.stack[-1], items)

    def _make_bytearray(self) -> None:
        """Read a bytearray (opcode ``BYTEARRAY8``).

        The method of the base class allocates memory for the size that the file names, even if the
        file is shorter.
        """
        (size,) = struct.unpack("<Q", self.read(8))
        self.append(bytearray(self.read(size)))  # read() returns at most the rest of the file

    def _refuse(self) -> None:
        """Raise an ``UnpicklingError`` for an opcode that makes objects or reads outside data."""
        raise pickle.UnpicklingError("it makes objects, which plain data does not need")

    # Method of each opcode, by the opcode's number. The constants of `pickle` are bytes of length
    # 1, so ``[0]`` and an iteration over their concatenation give the numbers.
    dispatch: ClassVar[dict[int, Any]] = {
        **pickle._Unpickler.dispatch,
        **dict.fromkeys(
            pickle.INST + pickle.OBJ + pickle.NEWOBJ + pickle.NEWOBJ_EX + pickle.EXT1 + pickle.EXT2
            + pickle.EXT4 + pickle.PERSID + pickle.BINPERSID + pickle.NEXT_BUFFER
            + pickle.READONLY_BUFFER, _refuse,
        ),
        pickle.BUILD[0]: _set_state,
        pickle.SETITEM[0]: _set_item,
        pickle.SETITEMS[0]: _set_items,
        pickle.ADDITEMS[0]: _add_items,
        pickle.DICT[0]: _make_dict,
        pickle.FROZENSET[0]: lambda self: self.append(frozenset(map(_key, self.pop_mark()))),
        pickle.BYTEARRAY8[0]: _make_bytearray,
        # A frame announces the size of the following data, so that a reader can load them at once.
        # The whole file is in memory already, so the size is skipped.
        pickle.FRAME[0]: lambda self: self.read(8),
    }  # fmt: skip


def _key(value: Any) -> Hashable:
    """Check a key of a dict or an element of a set, and return it.

    Wide integers and tuples with floats are rejected: an attacker can choose many of them with
    equal hashes, and building a dict of such keys takes quadratic time. A single float is accepted,
    since only few floats have equal hashes.
    """
    parts = value if isinstance(value, tuple) else (value,)
    for part in parts:
        if not isinstance(part, _KEYS):
            raise pickle.UnpicklingError(f"a key is a {type(value).__name__}")
    for part in parts:
        if isinstance(part, int) and part.bit_length() > _KEY_BITS:
            raise pickle.UnpicklingError(f"a key has a number of more than {_KEY_BITS} bits")
        if isinstance(part, float) and len(parts) > 1:
            raise pickle.UnpicklingError("a key is a tuple with a floating-point number")
    if len(parts) > _KEY_PARTS:
        raise pickle.UnpicklingError(f"a key has {len(parts)} parts")
    return value


def _fill(target: dict[Any, Any], items: list[Any]) -> None:
    """Add a list of alternating keys and values to a dict."""
    keys = map(_key, items[::2])
    values = items[1::2]
    target.update(zip(keys, values, strict=True))


def _count(value: Any, counts: dict[int, int], depth: int = 0) -> int:
    """Count the values in nested containers; a shared container counts once for each reference.

    Args:
        value: Value or container.
        counts: Number of values of each container, by its ``id``; 0 while it is being counted. The
            function adds the containers that it finds. An empty dict at the first call.
        depth: Number of enclosing containers.

    Returns:
        Number of values, with the containers, but without the keys of dicts.

    Raises:
        UnpicklingError: If a container holds itself, a function or a class, or if containers are
            nested more than 50 deep.
    """
    if callable(value):
        raise pickle.UnpicklingError("it holds a function or class, which is not plain data")
    if not isinstance(value, _CONTAINERS):
        return 1
    if depth > _MAX_DEPTH or counts.get(id(value)) == 0:
        raise pickle.UnpicklingError("a container holds itself, or containers are nested too deep")
    if id(value) not in counts:
        counts[id(value)] = 0
        items: Iterable[Any] = value.values() if isinstance(value, dict) else value
        total = 1
        for item in items:
            total += _count(item, counts, depth=depth + 1)
        counts[id(value)] = total
    return counts[id(value)]


def load_plain_pickle(path: str | Path) -> Any:
    """Read a pickle of plain containers and numpy arrays.

    Args:
        path: Pickle file, which may be untrusted.

    Returns:
        The content. Its arrays are of a subclass of ``numpy.ndarray``.

    Raises:
        FileNotFoundError: If the file is missing.
        ValueError: If the file is not a complete pickle, or holds more than plain data.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"There is no file {path}.")
    file = BytesIO(path.read_bytes())
    try:
        # Strings of Python 2, in which it stores the bytes of arrays, need the encoding "latin1".
        value = _PlainUnpickler(file, encoding="latin1").load()
        if file.read(1):
            raise pickle.UnpicklingError("more follows its end")
        # At the end of the file, its position is the number of bytes.
        if _count(value, {}) > _VALUES_PER_BYTE * file.tell():
            raise pickle.UnpicklingError(
                "it repeats its parts so often that the content is far larger than the file"
            )
    except _DAMAGE as error:
        raise InputError(
            f"{path} cannot be read as a pickle of plain data: {error}. Nothing of it was run: "
            "fetch it again, or save it with lists, dicts and numpy arrays only."
        ) from error
    return value
