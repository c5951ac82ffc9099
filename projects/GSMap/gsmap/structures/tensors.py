"""Small helpers of tensors that every room uses."""

import functools
import sys
from collections.abc import Callable, Hashable, Sequence
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor, nn
from torch._subclasses import FakeTensor

from gsmap.utils.errors import InputError

_ALIGNMENT = 64  # bytes, more than any type or kernel wants
_LARGE = 2**20  # bytes that a copy of its own is worth
_MOST_CONSTANTS = 4096  # of a process; further ones are made anew each time
_constants: dict[Hashable, Tensor] = {}
_Params = ParamSpec("_Params")
_Result = TypeVar("_Result")


def uncompiled(function: Callable[_Params, _Result]) -> Callable[_Params, _Result]:
    """Decorate a function that ``torch.compile`` must leave as it is.

    It is ``torch.compiler.disable`` from the moment that the compiler is there: importing it takes
    a second.
    """
    # no cache of functools: the compiler warns of it
    disabled: list[Callable[_Params, _Result]] = []

    @functools.wraps(function)
    def wrapped(*args: _Params.args, **kwargs: _Params.kwargs) -> _Result:
        if "torch._dynamo" not in sys.modules:
            return function(*args, **kwargs)
        if not disabled:
            disabled.append(torch.compiler.disable(function))
        return disabled[0](*args, **kwargs)

    return wrapped


def constant(like: Tensor, values: Any, dtype: torch.dtype | None = None) -> Tensor:
    """Numbers as a tensor, uploaded once: ``like.new_tensor(values)`` waits for a GPU every time.

    Args:
        like: Tensor whose device, and whose type by default, the numbers get.
        values: A number, or nested sequences of numbers.
        dtype: Another type.

    Returns:
        The tensor, shared by all callers: it must not be written to.
    """
    dtype = dtype or like.dtype
    if _is_traced(like):
        return like.new_tensor(values, dtype=dtype)
    key = _hashable(values)
    return kept(like, ("values", key, dtype), lambda: like.new_tensor(key, dtype=dtype))


def kept(like: Tensor, key: Hashable, make: Callable[[], Tensor]) -> Tensor:
    """A tensor that depends on nothing but its key, made at the first use on a device.

    It stays for the life of the process, since a captured CUDA graph may read its memory. It is
    none of a model's buffers, so it is neither copied nor saved with one.

    Args:
        like: Tensor whose device the result gets.
        key: Name and all settings that the values depend on, their type included.
        make: Computes the values on that device.

    Returns:
        The tensor, shared by all callers: it must not be written to.
    """
    if _is_traced(like):
        return make()
    place = (like.device, key)
    found = _constants.get(place)
    if found is None:
        with torch.inference_mode(False), torch.no_grad():  # a training may follow
            found = make()
        capturing = like.is_cuda and torch.cuda.is_current_stream_capturing()
        if not capturing and len(_constants) < _MOST_CONSTANTS:
            _constants[place] = found
    return found


def uploaded(tensors: Sequence[Tensor], device: torch.device) -> list[Tensor]:
    """Copy tensors from the host to a device, without a wait for what the device has to do.

    Small ones go as one block of memory, of which the results are views.

    Args:
        tensors: Of any shapes and types.
        device: Where they go; on the host, tensors stay as they are.

    Returns:
        The tensors there, contiguous.
    """
    if device.type == "cpu":
        return [tensor.to(device) for tensor in tensors]
    pinned = device.type == "cuda"
    found: list[Tensor] = []
    places = []  # of small tensors: number, first byte, bytes
    end = 0
    for number, tensor in enumerate(tensors):
        size = tensor.numel() * tensor.element_size()
        small = tensor.device.type == "cpu" and 0 < size < _LARGE
        if small:
            places.append((number, end, size))
            end += -(-size // _ALIGNMENT) * _ALIGNMENT
        source = tensor.pin_memory() if pinned and size and not small else tensor
        found.append(tensor if small else source.to(device, non_blocking=True).contiguous())
    block = torch.empty(end, dtype=torch.uint8, pin_memory=pinned)
    for number, start, size in places:
        part = block[start : start + size].view(tensors[number].dtype)
        part.view(tensors[number].shape).copy_(tensors[number])
    block = block.to(device, non_blocking=True)
    for number, start, size in places:
        part = block[start : start + size].view(tensors[number].dtype)
        found[number] = part.view(tensors[number].shape)
    return found


class LateValues:
    """Values on their way from a device to the host, which nothing waits for until they are read.

    Args:
        values: Of any shape.
    """

    def __init__(self, values: Tensor) -> None:
        self._host = values.detach().to("cpu", non_blocking=True)
        self._arrival = None
        if values.is_cuda:
            self._arrival = torch.cuda.Event()
            self._arrival.record(torch.cuda.current_stream(values.device))

    def read(self) -> Tensor:
        """Return the values, on the host."""
        if self._arrival is not None:
            self._arrival.synchronize()
        return self._host


def _is_traced(like: Tensor) -> bool:
    """Return whether a compiler or exporter records the operations on a tensor."""
    return torch.compiler.is_compiling() or torch.jit.is_tracing() or isinstance(like, FakeTensor)


def _hashable(values: Any) -> Any:
    """Return nested sequences of numbers, or an array, as tuples."""
    values = values.tolist() if hasattr(values, "tolist") else values
    if isinstance(values, Sequence):
        return tuple(_hashable(value) for value in values)
    return values


def at_least_float32(values: Tensor) -> Tensor:
    """Return half-precision values in float32, others as they are: coordinates need the digits."""
    return values.to(torch.promote_types(values.dtype, torch.float32))


def in_float32(layer: nn.Module, values: Tensor) -> Tensor:
    """Apply a layer outside of autocast and return its values in float32 or more.

    Neighbouring points differ in digits that half precision lacks: where they fall onto each other
    the direction of the edge between them, and the gradient of a loss of it, is noise.
    """
    if not torch.is_autocast_enabled(values.device.type):
        return at_least_float32(layer(values))
    with torch.autocast(values.device.type, enabled=False):
        return layer(at_least_float32(values))


def check_same_shape(**both: Tensor) -> None:
    """Raise ValueError if two tensors differ in shape; their names are those in the message."""
    (of, first), (name, second) = both.items()
    if first.shape != second.shape:
        raise InputError(
            f"{name} must have shape {tuple(first.shape)} of {of}, got {tuple(second.shape)}."
        )


def num_depth_bins(depth_range: tuple[float, float, float]) -> int:
    """Return the number of bins of ``(low, high, step)``; ValueError if there is none."""
    low, high, step = depth_range
    if step <= 0 or high - low < step:
        raise InputError(
            f"depth_range must be (low, high, step) with one bin or more, got {depth_range}."
        )
    return int((high - low) / step)


def tensor_versions(module: nn.Module) -> list[tuple[int, int]]:
    """Return address and version of a module's tensors, which change with every weight."""
    tensors = [*module.parameters(), *module.buffers()]
    return [(t.data_ptr(), 0 if t.is_inference() else t._version) for t in tensors]
