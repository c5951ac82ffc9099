"""Read a config file of plain assignments without running it."""

import ast
import copy
import operator
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from gsmap.utils.errors import InputError
from gsmap.utils.files import read_text

ARITHMETIC: dict[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul,
    ast.Div: operator.truediv, ast.FloorDiv: operator.floordiv,
}  # fmt: skip
_COPIED = 50_000  # values and characters that all earlier names stand for together
_LARGEST = 1e15  # numbers
_DEEPEST = 20
CALLS: dict[str, Callable[[Any], Any]] = {"len": len, "list": list, "tuple": tuple}


def read_assignments(path: str | Path) -> dict[str, Any]:
    """Return the values of a file's top-level names, as its last assignments leave them.

    Known are literals, earlier names, ``dict(...)`` with ``**``, ``len``, ``list``, ``tuple``,
    indices, and arithmetic of numbers, strings and lists. Nothing is executed, and no value shares
    a part with another.

    Raises:
        ValueError: If the file holds anything else; the message names the line.
    """
    names = _Names()
    source = read_text(path)
    try:
        tree = ast.parse(source)
    except SyntaxError as error:
        raise InputError(f"{path}, line {error.lineno}: {error.msg}.") from None
    except ValueError as error:  # a zero byte, before Python 3.12
        raise InputError(f"{path}: {error}.") from None
    except (RecursionError, MemoryError):
        raise InputError(f"{path} cannot be read: it is nested too deep.") from None
    for node in tree.body:
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            continue  # a docstring
        try:
            if not isinstance(node, ast.Assign):
                raise InputError("only assignments of names are read")
            for target in node.targets:
                if not isinstance(target, ast.Name):
                    raise InputError("only assignments of names are read")
                names[target.id] = _value(node.value, names)
        except (ValueError, TypeError, LookupError, ArithmeticError, RecursionError) as error:
            line = source.split("\n")[node.lineno - 1].strip()
            raise InputError(f"{path}, line {node.lineno}, {line[:80]!r}: {error}.") from None
    return dict(names)


class _Names(dict[str, Any]):
    """Values by name; what is taken is copied, and counts, as names of names of names grow fast."""

    _left = _COPIED

    def take(self, name: str) -> Any:
        """Return a copy of a value; ValueError if there is none, or all copies are too much."""
        if name not in self:
            raise InputError(f"{name} is not assigned before")
        self._count(self[name], 0)
        return copy.deepcopy(self[name])

    def _count(self, value: Any, depth: int) -> None:
        self._left -= len(value) if isinstance(value, str) else 1
        if self._left < 0 or depth > _DEEPEST:
            raise InputError("earlier names stand for too much, or for lists nested too deep")
        if isinstance(value, (list, tuple, dict)):
            for inner in (*value, *value.values()) if isinstance(value, dict) else value:
                self._count(inner, depth + 1)


def _value(node: ast.expr, names: _Names) -> Any:
    """Return what an expression stands for."""
    match node:
        case ast.Constant(value):
            return value
        case ast.Name(name):
            return names.take(name)
        case ast.List(items):
            return [_value(item, names) for item in items]
        case ast.Tuple(items):
            return tuple(_value(item, names) for item in items)
        case ast.Dict(keys, values):
            return _mapping(zip(keys, values, strict=True), names)
        case ast.Subscript(value, index):
            return _value(value, names)[_value(index, names)]
    return _computed(node, names)


def _computed(node: ast.expr, names: _Names) -> Any:
    """Return the value of a call or of arithmetic."""
    match node:
        case ast.Call(ast.Name("dict"), [], keywords):
            pairs = [(k.arg and ast.Constant(k.arg), k.value) for k in keywords]
            return _mapping(pairs, names)
        case ast.Call(ast.Name(name), [argument], []) if name in CALLS:
            return CALLS[name](_value(argument, names))
        case ast.Call(function):
            raise InputError(f"{ast.unparse(function)}() is not called")
        case ast.UnaryOp(ast.USub(), operand):
            return -_value(operand, names)
        case ast.BinOp(left, sign, right) if type(sign) in ARITHMETIC:
            sides = _value(left, names), _value(right, names)
            # a text or list multiplied may fill the memory
            if isinstance(sign, ast.Mult) and not all(isinstance(v, (int, float)) for v in sides):
                raise InputError("only numbers are multiplied")
            result = ARITHMETIC[type(sign)](*sides)
            if isinstance(result, (int, float)) and not abs(result) <= _LARGEST:
                raise InputError(f"no setting is beyond {_LARGEST:g}")
            return result
    raise InputError(f"{ast.unparse(node)!r} is more than a value")


def _mapping(pairs: Iterable[Any], names: _Names) -> dict[Any, Any]:
    """Return a dict of pairs of key and value nodes; a key of None stands for ``**``."""
    values: dict[Any, Any] = {}
    for key, node in pairs:
        values |= _value(node, names) if key is None else {_value(key, names): _value(node, names)}
    return values
