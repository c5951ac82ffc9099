"""Helpers for tensors: constants, copies to a device, precision and shapes."""

import functools
import sys
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor, nn
from torch._subclasses import FakeTensor

from gsmap.utils.errors import InputError

_ALIGNMENT = 64  # bytes, at least the alignment that any type or kernel needs
_LARGE = 2**20  # bytes; tensors of this size or more are copied separately
_MOST_CONSTANTS = 4096  # per process; further constants are not cached
_constants: dict[Hashable, Tensor] = {}  # by device and key, see `cached_constant`
_Params = ParamSpec("_Params")
_Result = TypeVar("_Result")


def exclude_from_compile(function: Callable[_Params, _Result]) -> Callable[_Params, _Result]:
    """Decorate a function that ``torch.compile`` must not compile.

    The decorator is ``torch.compiler.disable``, applied only once the compiler has been imported,
    since importing it takes a second.
    """
    # The excluded function, once it has been made. It is kept in a list instead of in
    # functools.cache, because the compiler warns about functions with such a cache.
    excluded: list[Callable[_Params, _Result]] = []

    @functools.wraps(function)
    def wrapper(*args: _Params.args, **kwargs: _Params.kwargs) -> _Result:
        if "torch._dynamo" not in sys.modules:  # the compiler has not been imported
            return function(*args, **kwargs)
        if not excluded:
            excluded.append(torch.compiler.disable(function))
        return excluded[0](*args, **kwargs)

    return wrapper


def constant(like: Tensor, values: Any, dtype: torch.dtype | None = None) -> Tensor:
    """Create a tensor of numbers that is uploaded once and cached.

    The simpler ``like.new_tensor(values)`` would wait for a GPU at every call.

    Args:
        like: Tensor with the device, and by default the type, of the result.
        values: A number, or nested sequences of numbers.
        dtype: Type of the result; None for the type of ``like``.

    Returns:
        Tensor, shared by all callers: it must not be written to.
    """
    dtype = dtype or like.dtype
    if _is_traced(like):  # a trace must contain the numbers, not a cached tensor
        return like.new_tensor(values, dtype=dtype)
    key = _hashable(values)
    # The type is part of the key, because the values depend on it.
    return cached_constant(like, ("values", key, dtype), lambda: like.new_tensor(key, dtype=dtype))


def cached_constant(like: Tensor, key: Hashable, make: Callable[[], Tensor]) -> Tensor:
    """Return a tensor that depends only on its key, computed at its first use on a device.

    The tensor is cached until the process ends, since a captured CUDA graph may read its memory. It
    is not a buffer of a module, so it is neither copied nor saved with a module.

    Args:
        like: Tensor with the device of the result.
        key: Name of the constant and all settings on which its values depend, including their type.
        make: Function that computes the values on the device.

    Returns:
        Tensor, shared by all callers: it must not be written to.
    """
    if _is_traced(like):
        return make()
    entry = (like.device, key)
    values = _constants.get(entry)
    if values is None:
        # A tensor that is made in inference mode could not be used in a later training.
        with torch.inference_mode(False), torch.no_grad():
            values = make()
        # A tensor that is made during a capture has values only after a replay of the graph.
        capturing = like.is_cuda and torch.cuda.is_current_stream_capturing()
        if not capturing and len(_constants) < _MOST_CONSTANTS:
            _constants[entry] = values
    return values


def upload(tensors: Sequence[Tensor], device: torch.device) -> list[Tensor]:
    """Copy tensors from the host to a device without waiting for pending work of the device.

    Small tensors are copied as one block of memory, and the results are views of the block.

    Args:
        tensors: Tensors of any shapes and types.
        device: Device of the copies. If it is the host, tensors that are already there are returned
            as they are.

    Returns:
        Tensors on the device, contiguous unless the device is the host.
    """
    if device.type == "cpu":
        return [tensor.to(device) for tensor in tensors]
    pinned = device.type == "cuda"  # only copies from pinned memory run in the background
    copies: list[Tensor] = []
    ranges: dict[int, slice] = {}  # bytes of the block that a small tensor takes
    end = 0
    for index, tensor in enumerate(tensors):
        size = tensor.numel() * tensor.element_size()
        # An empty tensor has no bytes in the block, so it is copied separately.
        if tensor.device.type == "cpu" and 0 < size < _LARGE:
            ranges[index] = slice(end, end + size)
            end += -(-size // _ALIGNMENT) * _ALIGNMENT  # rounded up to the alignment
            copies.append(tensor)  # replaced by a view of the block
            continue
        source = tensor.pin_memory() if pinned and size else tensor
        copies.append(source.to(device, non_blocking=True).contiguous())
    block = torch.empty(end, dtype=torch.uint8, pin_memory=pinned)
    for index, byte_range in ranges.items():
        part = block[byte_range].view(tensors[index].dtype)  # its bytes as numbers of this type
        part.view(tensors[index].shape).copy_(tensors[index])
    block = block.to(device, non_blocking=True)
    for index, byte_range in ranges.items():
        part = block[byte_range].view(tensors[index].dtype)
        copies[index] = part.view(tensors[index].shape)
    return copies


class LateValues:
    """Copy of a tensor to the host, which runs in the background until `read` waits for it.

    Args:
        values: Tensor of any shape on any device.
    """

    def __init__(self, values: Tensor) -> None:
        # On a GPU, the values are complete only when `_arrival` has occurred.
        self._host = values.detach().to("cpu", non_blocking=True)
        self._arrival = None  # event of the GPU at the end of the copy; None on other devices
        if values.is_cuda:
            self._arrival = torch.cuda.Event()
            self._arrival.record(torch.cuda.current_stream(values.device))

    def read(self) -> Tensor:
        """Wait for the copy and return the values on the host."""
        if self._arrival is not None:
            self._arrival.synchronize()
        return self._host


def _is_traced(like: Tensor) -> bool:
    """Whether a compiler or exporter records the operations on a tensor."""
    return torch.compiler.is_compiling() or torch.jit.is_tracing() or isinstance(like, FakeTensor)


def _hashable(values: Any) -> Any:
    """Convert nested sequences of numbers, or an array, to tuples."""
    if hasattr(values, "tolist"):
        values = values.tolist()
    if isinstance(values, Sequence) and not isinstance(values, str):
        return tuple(_hashable(value) for value in values)
    return values


def at_least_float32(values: Tensor) -> Tensor:
    """Convert values to float32, since half precision is too coarse for coordinates.

    Integers and bool become float32, too. A more precise type, such as float64, is kept.
    """
    return values.to(torch.promote_types(values.dtype, torch.float32))


def in_float32(layer: nn.Module, values: Tensor) -> Tensor:
    """Apply a layer outside of autocast and return its values in float32 or more.

    Half precision has too few digits for neighbouring points, so their rounded coordinates may
    coincide. The direction of the edge between two such points is noise, and so is the gradient of
    a loss on the direction.

    Args:
        layer: Layer with one input and one output.
        values: Input of the layer.

    Returns:
        Output of the layer, at least float32.
    """
    # Without autocast, the layer takes the values in their type, which is the type of its weights.
    if not torch.is_autocast_enabled(values.device.type):
        return at_least_float32(layer(values))
    with torch.autocast(values.device.type, enabled=False):
        return layer(at_least_float32(values))


def check_same_shape(**both: Tensor) -> None:
    """Raise ValueError if two tensors differ in shape.

    Args:
        both: The two tensors. Their keywords are their names in the message.
    """
    # Keyword arguments keep their order.
    (first_name, first), (second_name, second) = both.items()
    if first.shape != second.shape:
        raise InputError(
            f"{second_name} must have shape {tuple(first.shape)} of {first_name}, got "
            f"{tuple(second.shape)}."
        )


def num_depth_bins(depth_range: tuple[float, float, float]) -> int:
    """Count the depth bins of a range.

    Args:
        depth_range: Smallest depth, largest depth and size of a bin, in metres. A part of a bin at
            the end does not count.

    Raises:
        ValueError: If the range has no bin.
    """
    low, high, step = depth_range
    if step <= 0 or high - low < step:
        raise InputError(
            f"depth_range must be (low, high, step) with one bin or more, got {depth_range}."
        )
    # The small number makes up for rounding: 4.3 m have 43 bins of 0.1 m.
    return int((high - low) / step + 1e-6)


def tensor_versions(module: nn.Module) -> list[tuple[int, int]]:
    """Address and version of each parameter and buffer of a module, to detect changes of values.

    A change in place raises the version of a tensor. Tensors that were made in inference mode have
    no version, and get 0.
    """
    versions = []
    for tensor in (*module.parameters(), *module.buffers()):
        version = 0 if tensor.is_inference() else tensor._version
        versions.append((tensor.data_ptr(), version))
    return versions


@contextmanager
def matrix_products(in_tf32: bool) -> Iterator[None]:
    """Context manager that selects TF32 for float32 matrix products on a GPU.

    Args:
        in_tf32: Whether to use TF32; if not, the precision is not changed.
    """
    previous_precision = torch.get_float32_matmul_precision()
    if in_tf32:
        torch.set_float32_matmul_precision("high")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(previous_precision)


def is_recording(device_type: str) -> bool:
    """Whether work on a device of this type is being recorded in a CUDA graph."""
    return device_type == "cuda" and torch.cuda.is_current_stream_capturing()
