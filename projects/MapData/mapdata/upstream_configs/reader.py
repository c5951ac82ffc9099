"""Reader of config files that consist of plain assignments. The files are not executed."""

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
_COPIED = 50_000  # limit of copied values and characters, over all uses of earlier names
_LARGEST = 1e15  # limit of the absolute value of computed numbers
_DEEPEST = 20  # limit of the nesting of copied values
# Functions that a config may call, in addition to ``dict``.
CALLS: dict[str, Callable[[Any], Any]] = {"len": len, "list": list, "tuple": tuple}


def read_assignments(path: str | Path) -> dict[str, Any]:
    """Read the values of the top-level names of a config file.

    Supported are literals, earlier names, ``dict(...)`` with ``**``, ``len``, ``list``, ``tuple``,
    indices, and arithmetic of numbers, strings and lists. No code is executed.

    Args:
        path: Config file in Python.

    Returns:
        Values by name after the last assignment. The values share no mutable parts.

    Raises:
        ValueError: If the file contains anything else; the message names the line.
    """
    names = _Names()
    source = read_text(path)
    try:
        tree = ast.parse(source)
    except SyntaxError as error:
        raise InputError(f"{path}, line {error.lineno}: {error.msg}.") from None
    except ValueError as error:  # a zero byte, before Python 3.12
        raise InputError(f"{path}: {error}.") from None
    except (RecursionError, MemoryError):  # Python's parser raises either for deep nesting
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
    """Values by name, which are copied for each use.

    The total size of the copies is limited, because nested uses of names grow exponentially.
    """

    _remaining = _COPIED  # size of the copies that may still be made

    def copy_of(self, name: str) -> Any:
        """Copy the value of a name.

        Raises:
            ValueError: If the name is not assigned, or the limit of the copies is exceeded.
        """
        if name not in self:
            raise InputError(f"the name {name} is not assigned in an earlier line")
        self._count(self[name], depth=0)
        return copy.deepcopy(self[name])

    def _count(self, value: Any, depth: int) -> None:
        """Subtract the size of a value from the remaining size; ``depth`` is its nesting."""
        self._remaining -= len(value) if isinstance(value, str) else 1
        if self._remaining < 0 or depth > _DEEPEST:
            raise InputError("the values of earlier names are too large or nested too deep")
        if isinstance(value, dict):
            items: Iterable[Any] = (*value, *value.values())  # keys and values
        elif isinstance(value, (list, tuple)):
            items = value
        else:
            return
        for item in items:
            self._count(item, depth=depth + 1)


def _value(node: ast.expr, names: _Names) -> Any:
    """Evaluate an expression."""
    match node:
        case ast.Constant(value):
            return value
        case ast.Name(name):
            return names.copy_of(name)
        case ast.List(items):
            return [_value(item, names) for item in items]
        case ast.Tuple(items):
            return tuple(_value(item, names) for item in items)
        case ast.Dict(keys, values):
            return _mapping(zip(keys, values, strict=True), names)
        case ast.Subscript(value, index):
            container = _value(value, names)
            return container[_value(index, names)]
    return _compute(node, names)


def _compute(node: ast.expr, names: _Names) -> Any:
    """Evaluate a call or an arithmetic expression."""
    match node:
        case ast.Call(ast.Name("dict"), [], keywords):
            pairs: list[tuple[ast.expr | None, ast.expr]] = []
            for keyword in keywords:
                key = ast.Constant(keyword.arg) if keyword.arg else None  # None: `**` expression
                pairs.append((key, keyword.value))
            return _mapping(pairs, names)
        case ast.Call(ast.Name(name), [argument], []) if name in CALLS:
            return CALLS[name](_value(argument, names))
        case ast.Call(function):
            raise InputError(f"calls of {ast.unparse(function)}() are not evaluated")
        case ast.UnaryOp(ast.USub(), operand):
            return -_value(operand, names)
        case ast.BinOp(left, sign, right) if type(sign) in ARITHMETIC:
            first = _value(left, names)
            second = _value(right, names)
            are_numbers = isinstance(first, (int, float)) and isinstance(second, (int, float))
            if isinstance(sign, ast.Mult) and not are_numbers:
                # A repeated string or list may exceed the memory.
                raise InputError("only numbers can be multiplied")
            result = ARITHMETIC[type(sign)](first, second)
            # The negation also refuses NaN.
            if isinstance(result, (int, float)) and not abs(result) <= _LARGEST:
                raise InputError(f"the result is larger than {_LARGEST:g}, the limit of numbers")
            return result
    raise InputError(f"expressions such as {ast.unparse(node)!r} are not evaluated")


def _mapping(pairs: Iterable[Any], names: _Names) -> dict[Any, Any]:
    """Evaluate pairs of key and value nodes to a dict. The key of a ``**`` expression is None."""
    values: dict[Any, Any] = {}
    for key_node, value_node in pairs:
        if key_node is None:
            values |= _value(value_node, names)
        else:
            key = _value(key_node, names)
            values[key] = _value(value_node, names)
    return values
