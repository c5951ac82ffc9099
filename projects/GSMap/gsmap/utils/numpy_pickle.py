"""numpy's values in pickles, rebuilt from checked parts.

numpy's own functions trust what a pickle tells them: a crafted state turns a dtype into one of
Python objects, and bytes of the file into pointers. Those below stand in for them under their
names. They admit numbers, booleans and strings, and sizes that the file has bytes for.

Two readers rebuild numpy's values by these functions. Torch's reader (``weights_only``) reads
checkpoints (`checkpoints.safe_globals`), as it alone knows how torch stores tensors. It has no
instructions of the protocols 3 to 5, in which info files are written, so these have a reader of
their own (`mapdata.infos.plain_pickle`).
"""

import math
import pickle
import re
from typing import Any

import numpy as np

_CODE = re.compile(r"b1|[iu][1248]|f[248]|c8|c16|[SU][1-9]\d{0,3}")
_STATE_PARTS = {int, str, type(None)}
_MAX_DIMS = 8
_MAX_EMPTY = 1000  # length along an axis of an array without values
_LARGEST = {"b": 1, "U": 0x10FFFF}  # of booleans and characters, as integers


class CheckedDtype:
    """A dtype in a pickle: a number, boolean or string, in either byte order.

    What numpy writes beside its short name (alignment, copy) means nothing for such types.
    """

    __slots__ = ("dtype",)

    def __init__(self, code: Any = None, *options: Any) -> None:
        if not isinstance(code, str) or not _CODE.fullmatch(code):
            raise pickle.UnpicklingError(f"it holds values of dtype {code!r}, not plain ones")
        self.dtype: np.dtype[Any] = np.dtype(code)

    def __setstate__(self, state: Any) -> None:
        plain = isinstance(state, tuple) and {type(part) for part in state} <= _STATE_PARTS
        for candidate in (self.dtype.newbyteorder("<"), self.dtype.newbyteorder(">")):
            # just what numpy writes for this type
            if plain and state == candidate.__reduce__()[2]:
                self.dtype = candidate
                return
        raise pickle.UnpicklingError(f"it changes the dtype {self.dtype} in a way of its own")


class CheckedArray(np.ndarray):
    """An array in a pickle, made empty before its content; saved again, it is an ordinary one."""

    def __new__(cls, *arguments: Any) -> "CheckedArray":
        """Make an empty array."""
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
        if math.prod(shape) == 0 and max(shape) > _MAX_EMPTY:
            raise pickle.UnpicklingError(f"an array without values has the shape {shape!r:.80}")
        dtype = checked.dtype
        if math.prod(shape) * dtype.itemsize != len(data):
            raise pickle.UnpicklingError(f"an array {shape} of {dtype} has {len(data)} bytes")
        order = ">" if dtype.byteorder == ">" else "<"
        integers = {"b": "u1", "U": f"{order}u4"}.get(dtype.kind)
        if integers and data and np.frombuffer(data, integers).max() > _LARGEST[dtype.kind]:
            raise pickle.UnpicklingError(f"an array holds bytes that are no {dtype}")
        super().__setstate__((1, shape, dtype, bool(fortran), data))

    def __reduce_ex__(self, protocol: Any) -> Any:
        return np.asarray(self).__reduce_ex__(protocol)


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
