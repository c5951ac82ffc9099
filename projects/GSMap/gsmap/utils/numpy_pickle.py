"""Safe replacements of the functions with which pickles rebuild numpy arrays and scalars.

numpy's functions do not check the content of a pickle: a crafted state changes a dtype to Python
objects, and bytes of the file become pointers. The replacements accept numbers, booleans and
strings only, and arrays whose size matches the number of bytes in the file.

Two unpicklers use them. Torch's unpickler (``weights_only``) reads checkpoints
(`checkpoints.safe_globals`), because only torch can rebuild its tensors. It does not support the
pickle protocols 3 to 5 of info files, which `mapdata.infos.plain_pickle` reads.
"""

import math
import pickle
import re
from typing import Any

import numpy as np

# Short names of plain dtypes: booleans, integers, floats, complex numbers, and strings.
_CODE = re.compile(r"b1|[iu][1248]|f[248]|c8|c16|[SU][1-9]\d{0,3}")
# Types of the entries of the state of a plain dtype. The state is the tuple from which a pickle
# restores an object after its creation (``__setstate__``).
_STATE_TYPES = {int, str, type(None)}
_MAX_DIMS = 8
# Largest length of an axis of an array without values, which the number of bytes does not limit.
_MAX_EMPTY = 1000
# Largest boolean and largest character as integers, by the kind of dtype.
_MAX_INTEGER = {"b": 1, "U": 0x10FFFF}


class CheckedDtype:
    """Dtype from a pickle, for numbers, booleans or strings in either byte order.

    Args:
        code: Short name of the dtype, such as ``f4``.
        *options: Further arguments that numpy pickles (alignment, copy); no effect on such dtypes.

    Raises:
        pickle.UnpicklingError: If the dtype is not a plain one.
    """

    __slots__ = ("dtype",)

    def __init__(self, code: Any = None, *options: Any) -> None:
        if not isinstance(code, str) or not _CODE.fullmatch(code):
            raise pickle.UnpicklingError(f"it holds values of dtype {code!r}, not plain ones")
        self.dtype: np.dtype[Any] = np.dtype(code)

    def __setstate__(self, state: Any) -> None:
        is_plain = isinstance(state, tuple) and all(type(entry) in _STATE_TYPES for entry in state)
        # The only valid states are the ones that numpy writes for this dtype in either byte order.
        for candidate in (self.dtype.newbyteorder("<"), self.dtype.newbyteorder(">")):
            numpy_state = candidate.__reduce__()[2]  # state of this dtype in a pickle of numpy
            if is_plain and state == numpy_state:
                self.dtype = candidate
                return
        raise pickle.UnpicklingError(f"it changes the dtype {self.dtype} otherwise than numpy does")


class CheckedArray(np.ndarray):
    """Array from a pickle.

    The array is empty until its state is set. When it is pickled, it becomes an ordinary array.

    Raises:
        pickle.UnpicklingError: If the state does not have numpy's form, if its dtype is not a
            `CheckedDtype`, or if its shape does not fit the number of bytes.
    """

    def __new__(cls, *arguments: Any) -> "CheckedArray":
        """Create an empty array; arguments raise an ``UnpicklingError``."""
        if arguments:
            raise pickle.UnpicklingError("it makes an array otherwise than numpy does")
        return super().__new__(cls, shape=(0,), dtype=np.int8)

    def __setstate__(self, state: Any) -> None:  # type: ignore[override]
        try:
            _version, shape, checked_dtype, fortran, data = state
        except (TypeError, ValueError):
            raise pickle.UnpicklingError("the state of an array does not have five parts") from None
        if type(checked_dtype) is not CheckedDtype or not isinstance(data, bytes):
            raise pickle.UnpicklingError("an array holds something else than plain values")
        is_shape = isinstance(shape, tuple) and all(type(n) is int and n >= 0 for n in shape)
        if not is_shape or len(shape) > _MAX_DIMS:
            raise pickle.UnpicklingError(f"an array has the shape {shape!r}")
        size = math.prod(shape)
        if size == 0 and max(shape) > _MAX_EMPTY:
            raise pickle.UnpicklingError(f"an array without values has the shape {shape!r:.80}")
        dtype = checked_dtype.dtype
        if size * dtype.itemsize != len(data):
            raise pickle.UnpicklingError(f"an array {shape} of {dtype} has {len(data)} bytes")
        # Booleans above 1, and characters beyond Unicode, are not valid. The bytes are checked as
        # integers.
        integer_dtype = None  # for other kinds of dtypes, which may have any bytes
        if dtype.kind == "b":
            integer_dtype = "u1"
        elif dtype.kind == "U":
            integer_dtype = ">u4" if dtype.byteorder == ">" else "<u4"
        if integer_dtype and data:
            integers = np.frombuffer(data, dtype=integer_dtype)
            if integers.max() > _MAX_INTEGER[dtype.kind]:
                raise pickle.UnpicklingError(f"an array holds bytes that are no {dtype}")
        super().__setstate__((1, shape, dtype, bool(fortran), data))

    def __reduce_ex__(self, protocol: Any) -> Any:
        return np.asarray(self).__reduce_ex__(protocol)


def _array(kind: Any, *_placeholder: Any) -> CheckedArray:
    """Replacement of numpy's ``_reconstruct``, which creates an empty array.

    ``kind`` is the class of the array. A shape and a dtype follow, which the state replaces later.
    """
    if kind is not CheckedArray:
        raise pickle.UnpicklingError("it makes an array of another class than numpy.ndarray")
    return CheckedArray()


def _from_buffer(data: Any, dtype: Any, shape: Any, order: Any) -> CheckedArray:
    """Replacement of numpy's ``_frombuffer``, which creates an array from its bytes."""
    array = CheckedArray()
    # Pickles of protocol 5 may store the bytes as a bytearray.
    content = bytes(data) if isinstance(data, bytearray) else data
    array.__setstate__((1, shape, dtype, order == "F", content))
    return array


def _scalar(dtype: Any, data: Any) -> Any:
    """Replacement of numpy's ``scalar``, which creates a scalar from its bytes."""
    array = _from_buffer(data=data, dtype=dtype, shape=(), order="C")
    return np.asarray(array)[()]  # the scalar of an array without axes


def _encode(text: Any, encoding: Any) -> bytes:
    """Replacement of ``_codecs.encode``, with which older pickles store bytes."""
    if not isinstance(text, str) or encoding != "latin1":
        raise pickle.UnpicklingError(f"it encodes bytes as {encoding!r} instead of latin1")
    return text.encode("latin1")


# Names without the package, which is `numpy.core` before NumPy 2 and `numpy._core` since then.
_ARRAY_FUNCTIONS = {
    "multiarray._reconstruct": _array,
    "multiarray.scalar": _scalar,
    "numeric._frombuffer": _from_buffer,
}
CHECKED: dict[str, Any] = {
    "numpy.dtype": CheckedDtype,
    "numpy.ndarray": CheckedArray,
    "_codecs.encode": _encode,
    **{f"numpy.core.{name}": function for name, function in _ARRAY_FUNCTIONS.items()},
    **{f"numpy._core.{name}": function for name, function in _ARRAY_FUNCTIONS.items()},
}
"""Replacements, by the names of the replaced functions and classes in a pickle."""
