"""numpy's values in pickles, rebuilt from checked parts.

numpy's own functions trust what a pickle tells them: a crafted state turns a dtype into one of
Python objects, and bytes of the file into pointers. Those below stand in for them under their
names. They admit numbers, booleans and strings, and sizes that the file has bytes for.
"""

import math
import pickle
import re
from typing import Any

import numpy as np

_CODE = re.compile(r"b1|[iu][1248]|f[248]|c8|c16|[SU]\d{1,4}")
_STATE_PARTS = {int, str, type(None)}
_MAX_DIMS = 8
_LAST_CHARACTER = 0x10FFFF


class CheckedDtype:
    """A dtype in a pickle: the ``dtype`` of a plain type, in either byte order.

    Args:
        code: numpy's short name, such as ``f8``.
        *options: What numpy writes besides (alignment, copy); of no meaning for plain types.

    Raises:
        pickle.UnpicklingError: If it is not a number, boolean or string.
    """

    __slots__ = ("dtype",)

    dtype: np.dtype[Any]

    def __new__(cls, code: Any = None, *options: Any) -> "CheckedDtype":
        """Make the dtype; its byte order may follow as state."""
        if not isinstance(code, str) or not _CODE.fullmatch(code):
            raise pickle.UnpicklingError(f"it holds values of dtype {code!r}, not plain ones")
        new = super().__new__(cls)
        new.dtype = np.dtype(code)
        return new

    def __setstate__(self, state: Any) -> None:
        plain = isinstance(state, tuple) and {type(part) for part in state} <= _STATE_PARTS
        for candidate in (self.dtype.newbyteorder("<"), self.dtype.newbyteorder(">")):
            # just what numpy writes for this type
            if plain and state == candidate.__reduce__()[2]:
                self.dtype = candidate
                return
        raise pickle.UnpicklingError(f"it changes the dtype {self.dtype} in a way of its own")


class CheckedArray(np.ndarray):
    """An array in a pickle; saved again, it is an ordinary one.

    Raises:
        pickle.UnpicklingError: If it is made with arguments, or its content does not fit its shape.
    """

    def __new__(cls, *arguments: Any) -> "CheckedArray":
        """Make an empty array, whose content follows as state."""
        if arguments:
            raise pickle.UnpicklingError("it makes an array in a way of its own")
        return super().__new__(cls, (0,), np.int8)

    def __setstate__(self, state: Any) -> None:  # type: ignore[override]
        try:
            _version, shape, checked, fortran, data = state
        except (TypeError, ValueError):
            raise pickle.UnpicklingError("the state of an array has other parts") from None
        if type(checked) is not CheckedDtype or not isinstance(data, bytes):
            raise pickle.UnpicklingError("an array holds something else than plain values")
        whole = isinstance(shape, tuple) and all(type(n) is int and n >= 0 for n in shape)
        if not whole or len(shape) > _MAX_DIMS:
            raise pickle.UnpicklingError(f"an array has the shape {shape!r}")
        if math.prod(shape) * checked.dtype.itemsize != len(data):
            raise pickle.UnpicklingError(
                f"an array of shape {shape} and dtype {checked.dtype} has {len(data)} bytes"
            )
        _check_content(checked.dtype, data)
        super().__setstate__((1, shape, checked.dtype, bool(fortran), data))

    def __reduce_ex__(self, protocol: Any) -> Any:
        return np.asarray(self).__reduce_ex__(protocol)


def _check_content(dtype: np.dtype, data: bytes) -> None:
    """Refuse bytes that are no value of the dtype: booleans beyond 1, characters beyond Unicode."""
    largest = {"b": 1, "U": _LAST_CHARACTER}.get(dtype.kind)
    if largest is None or not data:
        return
    order = ">" if dtype.byteorder == ">" else "<"
    if np.frombuffer(data, "u1" if dtype.kind == "b" else f"{order}u4").max() > largest:
        raise pickle.UnpicklingError(f"an array holds bytes that are no {dtype}")


def _array(kind: Any, *_placeholder: Any) -> CheckedArray:
    """Stand in for ``_reconstruct``."""
    if kind is not CheckedArray:
        raise pickle.UnpicklingError("it makes an array of a class of its own")
    return CheckedArray()


def _from_buffer(data: Any, dtype: Any, shape: Any, order: Any) -> CheckedArray:
    """Stand in for ``_frombuffer``."""
    array = CheckedArray()
    content = bytes(data) if isinstance(data, bytearray) else data
    array.__setstate__((1, shape, dtype, order == "F", content))
    return array


def _scalar(dtype: Any, data: Any) -> Any:
    """Stand in for ``scalar``."""
    return np.asarray(_from_buffer(data, dtype, (), "C"))[()]


def _encode(text: Any, encoding: Any) -> bytes:
    """Stand in for ``_codecs.encode``, by which older pickles write bytes."""
    if not isinstance(text, str) or encoding != "latin1":
        raise pickle.UnpicklingError(f"it encodes as {encoding!r}")
    return text.encode("latin1")


CHECKED = {
    "numpy.dtype": CheckedDtype,
    "numpy.ndarray": CheckedArray,
    "_codecs.encode": _encode,
    **{
        f"numpy.{core}.{name}": function
        for core in ("core", "_core")
        for name, function in (
            ("multiarray._reconstruct", _array),
            ("multiarray.scalar", _scalar),
            ("numeric._frombuffer", _from_buffer),
        )
    },
}
"""What stands in for which name of a pickle."""
