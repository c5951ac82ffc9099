"""Pretended GPU: a device that computes on the CPU and counts the launches and waits of a GPU.

``with PretendedGPU() as gpu: model.to(DEVICE); ...`` computes real values, so code that depends on
values runs. Two mistakes raise the errors that they raise on a GPU: an operation on tensors of two
devices, and the conversion of a tensor on the GPU to numpy. A launch is the start of a kernel or
of a copy; views and allocations need no launch. A wait is an event at which the host waits for the
GPU: it reads a value, needs a size that depends on values, or uploads memory that is not pinned.
Each wait is counted with the line of the project that caused it.

The device needs torch's support for backends in Python, which torch calls experimental (see
`available`). Attention that torch fuses on a GPU counts as one launch, and this project's Triton
kernels are computed by their counterparts for the CPU.
"""

import bisect
import contextlib
import math
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from pathlib import Path
from types import FrameType
from typing import Any

import torch
import torch.nn.functional as F
import torch.utils._foreach_utils as foreach_utils
import torch.utils.backend_registration as registration
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing

from benchmarks.pretended_operators import (
    FREE,
    INDEXING,
    READS,
    REPLACEMENTS,
    WAITS,
    run_cpu_kernel,
)
from gsmap.ops import backends
from gsmap.utils.shipped import shipped_path

NAME = "pretended"  # device type, in place of "cuda"
DEVICE = f"{NAME}:0"
ROOT = shipped_path()  # root folder of the repository
aten = torch.ops.aten

# Largest number of tensors per list in one launch of a `torch._foreach_*` kernel, for kernels that
# take 1, 2, 3, 4 and 5 lists of tensors.
_TENSORS_PER_LAUNCH = (110, 64, 48, 36, 30)


def available() -> bool:
    """Whether this version of torch supports backends in Python."""
    return hasattr(registration, "_setup_privateuseone_for_python_backend")


def _register() -> None:
    """Register the device with torch, once per process."""
    # PrivateUse1 is torch's place for one additional device type.
    if torch._C._get_privateuse1_backend_name() == NAME:
        return

    class Backend(registration._DummyBackendModule):  # type: ignore[name-defined]
        # `torch.autocast` calls this method of a backend.
        def get_amp_supported_dtype(self) -> list[torch.dtype]:
            return [torch.float16, torch.bfloat16]

    registration._setup_privateuseone_for_python_backend(NAME, Backend())


class PretendedTensor(Tensor):
    """Tensor on the pretended GPU.

    Attributes:
        host: Values on the CPU, in the shape and type of the tensor.
    """

    host: Tensor

    @staticmethod
    def __new__(cls, data: Tensor) -> "PretendedTensor":
        """Wrap values on the CPU."""
        # torch takes the wrapper for a tensor on the device. It has no memory apart from `host`.
        tensor: Any = torch.Tensor._make_wrapper_subclass(
            cls,
            data.size(),
            strides=data.stride(),
            storage_offset=data.storage_offset(),
            dtype=data.dtype,
            layout=data.layout,
            requires_grad=data.requires_grad,
            device=torch.device(DEVICE),
        )
        tensor.host = data
        return tensor

    def __repr__(self, **_: Any) -> str:  # type: ignore[override]
        return f"PretendedTensor({self.host})"

    def numpy(self, *args: Any, **kwargs: Any) -> Any:
        """Raise TypeError, as for a tensor on a real GPU."""
        raise TypeError(f"can't convert a tensor on {DEVICE} to numpy: use Tensor.cpu() first.")

    def __array__(self, *args: Any, **kwargs: Any) -> Any:
        return self.numpy()

    def __deepcopy__(self, memo: dict[int, Any]) -> "PretendedTensor":
        copy: Any = PretendedTensor(self.host.detach().clone()).requires_grad_(self.requires_grad)
        # torch sets `_is_param` on a parameter whose tensor is of a subclass of `Tensor`.
        if getattr(self, "_is_param", False):
            copy._is_param = True  # type: ignore[attr-defined]
        memo[id(self)] = copy
        return copy

    def data_ptr(self) -> int:
        """Address of the values."""
        return self.host.data_ptr()

    def tolist(self) -> Any:
        """Values as nested lists. The host waits for them."""
        return self.cpu().tolist()

    @classmethod
    def __torch_dispatch__(  # type: ignore[override]  # torch declares an attribute
        cls, func: Any, types: Any, args: Any = (), kwargs: dict | None = None
    ) -> Any:
        # An active `PretendedGPU` handles operations before this method is called. torch calls this
        # method for operations outside of the context, and while the context handles another one.
        if PretendedGPU.current is None:
            raise RuntimeError(f"{func} of a tensor on {DEVICE} outside of PretendedGPU.")
        return PretendedGPU.current.run(func, args, kwargs or {})

    # Python functions of torch run as usual: only the operations that they call are intercepted.
    __torch_function__: Any = torch._C._disabled_torch_function_impl


class PretendedGPU(TorchDispatchMode):
    """Context in which the device can be used, with counts of its work.

    Attributes:
        current: The context that is active; None outside of a context.
        launches: Number of kernels and copies, by part and operation. A part is a section of the
            work that the caller names with `part`.
        waits: Number of waits of the host, by part, reason and line of code.
    """

    current: "PretendedGPU | None" = None

    def __init__(self) -> None:
        super().__init__()
        self.launches: Counter[tuple[str, str]] = Counter()
        self.waits: Counter[tuple[str, str, str]] = Counter()
        self._part = ""
        # Start of each part: the number of its first autograd node, and the name of the part.
        self._marks: list[tuple[int, str]] = []
        self._in_backward = False
        self._undo = contextlib.ExitStack()

    def __enter__(self) -> "PretendedGPU":
        _register()
        # The project reads two tables by the name of a backend, ``cpu`` or ``triton``: the device
        # type of its tensors, and whether its package is installed.
        devices = {**backends.DEVICES, "triton": NAME}
        installed = {**backends.INSTALLED, "triton": True}
        foreach_types = [*foreach_utils._foreach_supported_types, PretendedTensor]
        changes = (
            # This dispatch mode does not reach the threads in which autograd usually runs backward.
            torch.autograd.set_multithreading_enabled(False),
            # `Module.to` makes new parameters: it cannot put pretended values into the old ones.
            _flag(torch.__future__.set_overwrite_module_params_on_conversion),
            # `torch.tensor(.., device)` makes a tensor on the CPU and then uploads it.
            _flag(torch._C._set_only_lift_cpu_tensors),
            # Without a replacement, attention would be several operations on this device.
            _replace_attribute(F, "scaled_dot_product_attention", _attention),
            # The project chooses its Triton kernels for tensors on this device.
            _replace_attribute(backends, "DEVICES", devices),
            _replace_attribute(backends, "INSTALLED", installed),
            # Optimizers and the clipping of gradients use `_foreach` kernels, as on a GPU.
            _replace_attribute(foreach_utils, "_foreach_supported_types", foreach_types),
        )
        for change in changes:
            self._undo.enter_context(change)
        PretendedGPU.current = self
        return super().__enter__()

    def __exit__(self, exc_type: Any, exc: Any, traceback: Any) -> None:
        PretendedGPU.current = None
        super().__exit__(exc_type, exc, traceback)
        self._undo.close()

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict | None = None
    ) -> Any:
        return self.run(func, args, kwargs or {})

    def clear(self) -> None:
        """Reset the counts to zero."""
        self.launches.clear()
        self.waits.clear()

    @contextlib.contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Count the work inside the context for a part.

        The gradients of this work are computed later, inside of `backward`. That work is counted
        for the part ``backward: NAME``.

        Args:
            name: Name of the part.
        """
        outer_part = self._part
        self._begin(name)
        try:
            yield
        finally:
            self._begin(outer_part)

    def _begin(self, part: str) -> None:
        """Count the work from here on, and later its gradients, for a part."""
        self._part = part
        # The sequence number is the number that autograd gives to its next node.
        self._marks.append((torch._C._autograd._get_sequence_nr(), part))

    @contextlib.contextmanager
    def backward(self) -> Iterator[None]:
        """Count each launch inside the context for the part whose gradient it computes."""
        outer_part = self._part
        self._in_backward = True
        try:
            yield
        finally:
            self._in_backward = False
            self._part = outer_part

    def run(self, func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
        """Compute an operation on the CPU and count it.

        Args:
            func: Operation of torch.
            args: Positional arguments.
            kwargs: Arguments by name.

        Returns:
            Result of the operation.
        """
        tensors = [*_tensors_in(args), *_tensors_in(kwargs.values())]
        on_gpu = any(isinstance(tensor, PretendedTensor) for tensor in tensors)
        target = kwargs.get("device")
        # A function such as `torch.zeros` creates its result on the device that it is given.
        to_gpu = target is not None and torch.device(target).type == NAME
        if not on_gpu and not to_gpu:
            return func(*args, **kwargs)
        if self._in_backward:
            self._part = self._part_of_gradient()
        if func is aten._to_copy.default:  # `Tensor.to` with another type or device
            return self._convert(args[0], kwargs)
        if func is aten.copy_.default:  # `Tensor.copy_`
            return self._copy_into(*args, **kwargs)
        name = str(func).removeprefix("aten.").removesuffix(".default")
        if on_gpu:
            self._check_devices(func, name, args=args, tensors=tensors)
        if func in (aten.lift_fresh.default, aten.lift.default):
            return args[0]  # marks a constant, and computes nothing
        # Without `output_size`, the length of the result depends on the values.
        repeats_by_values = (
            func is aten.repeat_interleave.Tensor and kwargs.get("output_size") is None
        )
        if func in WAITS or repeats_by_values:
            self._wait(name)
        if not func.is_view and func not in FREE:
            self._launch(name, _num_launches(name, args))
        return self._compute(func, name, args=args, kwargs=kwargs, on_gpu=on_gpu)

    def _compute(
        self, func: Any, name: str, args: Any, kwargs: dict[str, Any], on_gpu: bool
    ) -> Any:
        """Compute an operation on the CPU.

        Args:
            func: Operation of torch.
            name: Name of the operation.
            args: Positional arguments.
            kwargs: Arguments by name.
            on_gpu: Whether a tensor among the arguments is on the device.

        Returns:
            Result of the operation, with its tensors on the device.
        """
        # Pinned memory needs a real GPU, and the CPU does not need it.
        kwargs = {key: value for key, value in kwargs.items() if key != "pin_memory"}
        if "device" in kwargs:
            kwargs["device"] = torch.device("cpu")
        host_args = _to_host(args)
        host_kwargs = {key: _to_host(value) for key, value in kwargs.items()}
        is_project_kernel = name.startswith("gsmap.")
        if is_project_kernel:
            result = run_cpu_kernel(name, host_args)
        else:
            function = REPLACEMENTS.get(func, func)
            result = function(*host_args, **host_kwargs)
        if func in READS:
            return result  # a number or bool of Python, not a tensor
        result = _to_gpu(result)
        if not on_gpu or is_project_kernel or func in REPLACEMENTS:
            return result  # new tensors, which share no memory with an argument
        # A view shares the storage of its argument, and an operation in place returns its argument.
        return return_and_correct_aliasing(func, args, kwargs=kwargs, out=result)

    def _convert(self, source: Tensor, kwargs: dict[str, Any]) -> Tensor:
        """Copy a tensor to another type or device. The source or the result is a pretended tensor.

        Args:
            source: Tensor on the CPU or on the device.
            kwargs: Arguments of ``aten._to_copy`` by name, such as ``device`` and ``dtype``.
        """
        target = kwargs.get("device")  # without it, the tensor stays on its device
        device_type = torch.device(target).type if target is not None else source.device.type
        is_blocking = not kwargs.get("non_blocking")
        options = {k: v for k, v in kwargs.items() if k not in ("device", "pin_memory")}
        if not isinstance(source, PretendedTensor):
            if is_blocking:
                self._wait("upload")
            self._launch("upload")
            return PretendedTensor(aten._to_copy.default(source, **options))
        if device_type == "cpu":
            if is_blocking:
                self._wait("download")
            self._launch("download")
            return aten._to_copy.default(source.host, **options)
        dtype = kwargs.get("dtype") or source.dtype
        source_name = str(source.dtype).removeprefix("torch.")
        target_name = str(dtype).removeprefix("torch.")
        self._launch(f"cast {source_name} to {target_name}")
        return PretendedTensor(aten._to_copy.default(source.host, **options))

    def _copy_into(self, target: Tensor, source: Tensor, non_blocking: bool = False) -> Tensor:
        """Copy the values of ``source`` into ``target``, in place, and return ``target``."""
        from_gpu = isinstance(source, PretendedTensor)
        into_gpu = isinstance(target, PretendedTensor)
        if from_gpu and into_gpu:
            self._launch("copy_")
        else:
            name = "upload" if into_gpu else "download"
            if not non_blocking:
                self._wait(name)
            self._launch(name)
        host_target = target.host if isinstance(target, PretendedTensor) else target
        host_source = source.host if isinstance(source, PretendedTensor) else source
        aten.copy_.default(host_target, host_source)
        return target

    def _check_devices(self, func: Any, name: str, args: Any, tensors: list[Tensor]) -> None:
        """Check that tensors are on one device.

        Tensors of dimension 0, and indices into a tensor on the device, may be on the CPU.

        Args:
            func: Operation of torch.
            name: Name of the operation.
            args: Positional arguments. For an operation in ``INDEXING``, the first one is the
                indexed tensor, and the second one lists an index, or None, for each axis.
            tensors: All tensors among the arguments.

        Raises:
            RuntimeError: If tensors are on two devices.
        """
        if func not in INDEXING:
            if any(t.dim() and not isinstance(t, PretendedTensor) for t in tensors):
                raise RuntimeError(
                    "Expected all tensors to be on the same device, but found at least two "
                    f"devices, {DEVICE} and cpu! ({name})"
                )
            return
        if not isinstance(args[0], PretendedTensor):
            raise RuntimeError(
                "indices should be either on cpu or on the same device as the indexed tensor (cpu) "
                f"({name})"
            )
        indices = [index for index in args[1] if index is not None]
        for index in indices:
            if not isinstance(index, PretendedTensor):
                self._wait("upload of an index")
                self._launch("upload")
        # A mask selects a number of elements that depends on its values.
        if any(index.dtype in (torch.bool, torch.uint8) for index in indices):
            self._wait("boolean index")

    def _part_of_gradient(self) -> str:
        """Part whose gradient autograd is computing.

        Sums of gradients belong to no node of the forward pass. They are counted for
        ``backward: sums``. Gradients of work outside of all parts are counted for
        ``backward: rest``.
        """
        node = torch._C._current_autograd_node()
        if node is None or "AccumulateGrad" in node.name():
            return "backward: sums"
        # Nodes are numbered in the order of the forward pass, so this node was made in the part
        # with the last mark at or before its number.
        number = node._sequence_nr()
        marks_before = bisect.bisect_right(self._marks, number, key=lambda mark: mark[0])
        part = ""
        if marks_before:
            _, part = self._marks[marks_before - 1]
        return f"backward: {part or 'rest'}"

    def _launch(self, name: str, times: int = 1) -> None:
        self.launches[self._part, name] += times

    def _wait(self, reason: str) -> None:
        self.waits[self._part, reason, _line_of_project()] += 1


def _tensors_in(values: Iterable[Any]) -> Iterator[Tensor]:
    """Tensors among an operation's arguments and in lists among them."""
    for value in values:
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, list | tuple):
            yield from _tensors_in(value)


def _to_host(value: Any) -> Any:
    """Replace each pretended tensor in an argument by its values on the CPU."""
    if isinstance(value, PretendedTensor):
        return value.host
    if isinstance(value, list | tuple):
        return type(value)(_to_host(item) for item in value)
    return value


def _to_gpu(result: Any) -> Any:
    """Wrap each tensor in a result as a pretended tensor."""
    if isinstance(result, Tensor):
        return PretendedTensor(result)
    if isinstance(result, list | tuple):
        return type(result)(_to_gpu(item) for item in result)
    return result


def _line_of_project() -> str:
    """Innermost line of the project or of OpenMMLab on the stack, as ``file:line``; else ``?``."""
    frame: FrameType | None = sys._getframe(2)  # caller of `_wait`
    while frame is not None:
        name = _short_name(frame.f_code.co_filename)
        if name is not None:
            return f"{name}:{frame.f_lineno}"
        frame = frame.f_back
    return "?"


@cache
def _short_name(file: str) -> str | None:
    """Short name of a file of the project or of OpenMMLab; None for this file and all others.

    The name is relative to the repository, or to ``site-packages`` for OpenMMLab.
    """
    path = Path(file)
    if path.is_relative_to(ROOT) and "site-packages" not in path.parts:
        return str(path.relative_to(ROOT)) if path != Path(__file__) else None
    if "site-packages" not in path.parts:
        return None
    # The first folder is the package. The packages of OpenMMLab are mmcv, mmdet, mmdet3d and
    # mmengine.
    folders = path.parts[path.parts.index("site-packages") + 1 :]
    return "/".join(folders) if folders[0].startswith("mm") else None


def _num_launches(name: str, args: Any) -> int:
    """Number of kernels of an operation.

    Operations on lists of tensors, all of one length, need one kernel for each group of tensors.
    ``_TENSORS_PER_LAUNCH`` has the size of a group. Its last entry is also used for more than five
    lists.
    """
    if not name.startswith(("_foreach", "_fused_adam", "_fused_sgd")):
        return 1
    num_lists = 0
    for arg in args:
        if isinstance(arg, list | tuple) and len(arg) and isinstance(arg[0], Tensor):
            num_lists += 1
    counted_lists = min(max(num_lists, 1), len(_TENSORS_PER_LAUNCH))
    group_size = _TENSORS_PER_LAUNCH[counted_lists - 1]  # the first entry is for one list
    return math.ceil(len(args[0]) / group_size)


@contextlib.contextmanager
def _flag(set_flag: Callable[[bool], None]) -> Iterator[None]:
    """Set a flag of torch, off by default, inside the context."""
    set_flag(True)
    try:
        yield
    finally:
        set_flag(False)


@contextlib.contextmanager
def _replace_attribute(owner: Any, name: str, value: Any) -> Iterator[None]:
    """Replace an attribute inside the context."""
    original = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, original)


# torch's function, which `_attention` replaces inside of `PretendedGPU`.
_plain_attention = F.scaled_dot_product_attention


def _attention(
    query: Tensor,
    key: Tensor,
    value: Tensor,
    attn_mask: Tensor | None = None,
    dropout_p: float = 0.0,
    is_causal: bool = False,
    **kwargs: Any,
) -> Tensor:
    """Compute attention.

    Tensors on the pretended GPU use torch's memory-efficient kernel, with any mask and without one.

    Args:
        query: Queries. (B, heads, N, C)
        key: Keys. (B, heads, K, C)
        value: Values. (B, heads, K, C)
        attn_mask: True where attention is allowed, or values to add to the logits. (..., N, K)
        dropout_p: Probability of dropout.
        is_causal: Whether a query attends only to keys at or before its position.
        kwargs: Further arguments of torch's function.

    Returns:
        Weighted sums of the values. (B, heads, N, C)
    """
    if not isinstance(query, PretendedTensor):
        return _plain_attention(query, key, value, attn_mask, dropout_p, is_causal, **kwargs)
    bias = attn_mask
    if bias is not None:
        if bias.dtype == torch.bool:
            zeros = torch.zeros_like(bias, dtype=query.dtype)
            bias = zeros.masked_fill_(bias.logical_not(), float("-inf"))
        batch, heads, num_queries, _ = query.shape
        bias = bias.expand(batch, heads, num_queries, key.shape[2])
    # The kernel computes the log-sums of the softmax only if backward will read them. They are
    # among its further results, which are not used here.
    needs_gradient = torch.is_grad_enabled()
    return aten._scaled_dot_product_efficient_attention(
        query, key, value, bias, needs_gradient, dropout_p, is_causal
    )[0]
