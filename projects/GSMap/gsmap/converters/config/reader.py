"""Read a config file of plain assignments without running it."""

import ast
import copy
import operator
from collections.abc import Callable
from pathlib import Path
from typing import Any

ARITHMETIC: dict[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv,
}
CALLS: dict[str, Callable[[Any], Any]] = {"len": len, "list": list, "tuple": tuple}


def read_assignments(path: str | Path) -> dict[str, Any]:
    """Return the values of a file's top-level names, as its last assignments leave them.

    Known are literals, earlier names, ``dict(...)`` with ``**``, ``len``, ``list``, ``tuple``,
    indices, and arithmetic of numbers, strings and lists. Nothing is executed.

    Args:
        path: The file.

    Returns:
        Values by name; none shares a part with another.

    Raises:
        ValueError: If the file holds anything else; the message names the line.
    """
    names: dict[str, Any] = {}
    try:
        tree = ast.parse(Path(path).read_text())
    except SyntaxError as error:
        raise ValueError(f"{path}, line {error.lineno}: {error.msg}.") from None
    for node in tree.body:
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            continue  # a docstring
        try:
            if not isinstance(node, ast.Assign) or not isinstance(node.targets[0], ast.Name):
                raise ValueError("only assignments of names are read")
            names[node.targets[0].id] = _value(node.value, names)
        except (ValueError, TypeError, LookupError, ArithmeticError) as error:
            line = ast.unparse(node).splitlines()[0]
            raise ValueError(f"{path}, line {node.lineno}, {line!r}: {error}.") from None
    return names


def _value(node: ast.expr, names: dict[str, Any]) -> Any:
    """Return what an expression stands for."""
    if isinstance(node, ast.Constant):
        return node.value
    if isinstance(node, ast.Name):
        if node.id not in names:
            raise ValueError(f"{node.id} is not assigned before")
        return copy.deepcopy(names[node.id])
    if isinstance(node, (ast.List, ast.Tuple)):
        values = [_value(element, names) for element in node.elts]
        return values if isinstance(node, ast.List) else tuple(values)
    if isinstance(node, ast.Dict):
        return _mapping(zip(node.keys, node.values, strict=True), names)
    if isinstance(node, ast.Call):
        return _call(node, names)
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        return -_value(node.operand, names)
    if isinstance(node, ast.BinOp) and type(node.op) in ARITHMETIC:
        return _arithmetic(node.op, _value(node.left, names), _value(node.right, names))
    if isinstance(node, ast.Subscript):
        return _value(node.value, names)[_value(node.slice, names)]
    raise ValueError(f"{ast.unparse(node)!r} is more than a value")


def _arithmetic(sign: ast.operator, left: Any, right: Any) -> Any:
    """Return a sum, difference, product or quotient; text and lists are added, not multiplied."""
    if isinstance(sign, ast.Mult) and not all(isinstance(v, (int, float)) for v in (left, right)):
        raise ValueError("only numbers are multiplied")
    return ARITHMETIC[type(sign)](left, right)


def _mapping(pairs: Any, names: dict[str, Any]) -> dict[Any, Any]:
    """Return a dict of pairs of key and value nodes; a key of None stands for ``**``."""
    values: dict[Any, Any] = {}
    for key, node in pairs:
        if key is None:
            values.update(_value(node, names))
        else:
            values[key if isinstance(key, str) else _value(key, names)] = _value(node, names)
    return values


def _call(node: ast.Call, names: dict[str, Any]) -> Any:
    """Return the value of a call of `dict` or of a name in `CALLS`."""
    name = node.func.id if isinstance(node.func, ast.Name) else ""
    if name == "dict" and not node.args:
        return _mapping([(keyword.arg, keyword.value) for keyword in node.keywords], names)
    if name in CALLS and len(node.args) == 1 and not node.keywords:
        return CALLS[name](_value(node.args[0], names))
    raise ValueError(f"{ast.unparse(node.func)}() is not called")
