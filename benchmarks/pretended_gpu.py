"""A GPU that is not there: tensors that compute on the CPU, every launch and wait counted.

``with PretendedGPU() as gpu: model.to(DEVICE); ...`` computes real values, so code that depends on
values runs. It raises where a GPU would: tensors of two devices in one operation, numpy of a tensor
on the GPU. It counts what a GPU would be given: each kernel and copy (views and allocations are
none), and each time that the host waits for the GPU (a value that is read, a size that depends on
values, an upload from memory that is not pinned), with the line of the project that caused it.

It stands on torch's support for backends in Python, which torch calls experimental: `available`
says whether this torch has it. Attention that torch fuses on a GPU is one launch here, and this
project's Triton kernels are computed by what serves the CPU.
"""

import bisect
import contextlib
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
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

from gsmap.ops import backends
from gsmap.ops.deformable_sampling import deformable_sample
from gsmap.ops.kernel_sampling.reference import sample_kernels_reference
from gsmap.utils.shipped import shipped

NAME = "pretended"
DEVICE = f"{NAME}:0"
ROOT = shipped()
aten = torch.ops.aten

# neither kernels nor copies, although no views by their schema
_FREE = {
    *(aten.detach.default, aten.alias.default, aten.lift_fresh.default, aten.lift.default),
    *(aten.empty.memory_format, aten.empty_strided.default, aten.empty_like.default),
    *(aten.new_empty.default, aten.new_empty_strided.default, aten.resize_.default),
    *(aten._unsafe_view.default, aten._reshape_alias.default, aten.set_.source_Tensor),
    *(aten.is_same_size.default, aten.sym_size.int),
}
# the host must know what only the device knows
_WAITS = {
    *(aten._local_scalar_dense.default, aten.is_nonzero.default, aten.equal.default),
    *(aten.nonzero.default, aten.masked_select.default, aten.bincount.default),
    *(aten._unique2.default, aten.unique_consecutive.default, aten.unique_dim.default),
    aten._linalg_check_errors.default,
}
_READS = {aten._local_scalar_dense.default, aten.is_nonzero.default, aten.equal.default}
_INDEXING = {
    *(aten.index.Tensor, aten.index_put.default, aten.index_put_.default),
    *(aten._index_put_impl_.default, aten._unsafe_index.Tensor),
}
_TENSORS_A_LAUNCH = (110, 64, 48, 36, 30)  # of kernels for lists of tensors, by number of lists


def available() -> bool:
    """Return whether this torch can have a backend in Python."""
    return hasattr(registration, "_setup_privateuseone_for_python_backend")


def _register() -> None:
    """Make the device known to torch, once a process."""
    if torch._C._get_privateuse1_backend_name() == NAME:
        return

    class Backend(registration._DummyBackendModule):  # type: ignore[name-defined]
        def get_amp_supported_dtype(self) -> list[torch.dtype]:
            return [torch.float16, torch.bfloat16]

    registration._setup_privateuseone_for_python_backend(NAME, Backend())


class PretendedTensor(Tensor):
    """A tensor that says it is on the pretended GPU; its values lie in ``host``."""

    host: Tensor

    @staticmethod
    def __new__(cls, data: Tensor) -> "PretendedTensor":
        """Wrap values that lie on the host."""
        made: Any = torch.Tensor._make_wrapper_subclass(
            cls,
            data.size(),
            strides=data.stride(),
            storage_offset=data.storage_offset(),
            dtype=data.dtype,
            layout=data.layout,
            requires_grad=data.requires_grad,
            device=torch.device(DEVICE),
        )
        made.host = data
        return made

    def __repr__(self, **_: Any) -> str:  # type: ignore[override]
        return f"PretendedTensor({self.host})"

    def numpy(self, *args: Any, **kwargs: Any) -> Any:
        """Refuse, as a GPU's tensor does."""
        raise TypeError(f"can't convert a tensor on {DEVICE} to numpy: use Tensor.cpu() first.")

    def __array__(self, *args: Any, **kwargs: Any) -> Any:
        return self.numpy()

    def __deepcopy__(self, memo: dict[int, Any]) -> "PretendedTensor":
        copied: Any = PretendedTensor(self.host.detach().clone()).requires_grad_(self.requires_grad)
        if getattr(self, "_is_param", False):
            copied._is_param = True  # type: ignore[attr-defined]
        memo[id(self)] = copied
        return copied

    def data_ptr(self) -> int:
        """Return the address of the values."""
        return self.host.data_ptr()

    def tolist(self) -> Any:
        """Return the values as nested lists, which waits."""
        return self.cpu().tolist()

    @classmethod
    def __torch_dispatch__(  # type: ignore[override]  # torch's is no method by its types
        cls, func: Any, types: Any, args: Any = (), kwargs: dict | None = None
    ) -> Any:
        if PretendedGPU.current is None:
            raise RuntimeError(f"{func} of a tensor on {DEVICE} outside of PretendedGPU.")
        return PretendedGPU.current.run(func, args, kwargs or {})

    __torch_function__: Any = torch._C._disabled_torch_function_impl


class PretendedGPU(TorchDispatchMode):
    """Counts what a GPU would do, while it is entered.

    Attributes:
        launches: Kernels and copies, by part and operation.
        waits: How often the host waits, by part, reason and line.
    """

    current: "PretendedGPU | None" = None

    def __init__(self) -> None:
        super().__init__()
        self.launches: Counter[tuple[str, str]] = Counter()
        self.waits: Counter[tuple[str, str, str]] = Counter()
        self._part = ""
        self._marks: list[tuple[int, str]] = []  # number of the next node of autograd, part
        self._in_backward = False
        self._undo = contextlib.ExitStack()

    def __enter__(self) -> "PretendedGPU":
        _register()
        change = self._undo.enter_context
        change(torch.autograd.set_multithreading_enabled(False))  # or backward leaves this mode
        # a parameter is replaced when it moves, for its memory cannot be
        change(_flag(torch.__future__.set_overwrite_module_params_on_conversion))
        change(_flag(torch._C._set_only_lift_cpu_tensors))  # torch.tensor(.., device) is an upload
        change(_replaced(F, "scaled_dot_product_attention", _attention))
        change(_replaced(backends, "DEVICES", {**backends.DEVICES, "triton": NAME}))
        installed = {**backends.INSTALLED, "triton": True}
        change(_replaced(backends, "INSTALLED", installed))
        types = [*foreach_utils._foreach_supported_types, PretendedTensor]
        change(_replaced(foreach_utils, "_foreach_supported_types", types))
        PretendedGPU.current = self
        return super().__enter__()

    def __exit__(self, *exception: Any) -> None:
        PretendedGPU.current = None
        super().__exit__(*exception)
        self._undo.close()

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict | None = None
    ) -> Any:
        return self.run(func, args, kwargs or {})

    def clear(self) -> None:
        """Forget what was counted."""
        self.launches.clear()
        self.waits.clear()

    @contextlib.contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Count what happens within as a part's; its gradients are then a part, too."""
        before = self._part
        self._begin(name)
        try:
            yield
        finally:
            self._begin(before)

    def _begin(self, part: str) -> None:
        self._part = part
        self._marks.append((torch._C._autograd._get_sequence_nr(), part))

    @contextlib.contextmanager
    def backward(self) -> Iterator[None]:
        """Count each launch within as one of the part whose gradient it computes."""
        before, self._in_backward = self._part, True
        try:
            yield
        finally:
            self._in_backward, self._part = False, before

    def run(self, func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
        """Compute an operation on the CPU and count it."""
        tensors = [*_tensors_in(args), *_tensors_in(kwargs.values())]
        on_gpu = any(isinstance(tensor, PretendedTensor) for tensor in tensors)
        target = kwargs.get("device")
        to_gpu = target is not None and torch.device(target).type == NAME
        if not on_gpu and not to_gpu:
            return func(*args, **kwargs)
        if self._in_backward:
            self._part = self._part_of_gradient()
        if func is aten._to_copy.default:
            return self._copied(args[0], kwargs)
        if func is aten.copy_.default:
            return self._copied_into(*args, **kwargs)
        name = str(func).removeprefix("aten.").removesuffix(".default")
        if on_gpu:
            self._check_devices(func, name, args, tensors)
        if func in (aten.lift_fresh.default, aten.lift.default):
            return args[0]
        sized = func is aten.repeat_interleave.Tensor and kwargs.get("output_size") is None
        if func in _WAITS or sized:
            self._wait(name)
        if not func.is_view and func not in _FREE:
            self._launch(name, _num_launches(name, args))
        return self._computed(func, name, args, kwargs, on_gpu)

    def _computed(
        self, func: Any, name: str, args: Any, kwargs: dict[str, Any], on_gpu: bool
    ) -> Any:
        """Compute an operation on the CPU."""
        kwargs = {key: value for key, value in kwargs.items() if key != "pin_memory"}
        if "device" in kwargs:
            kwargs["device"] = torch.device("cpu")
        inner = _on_host(args)
        options = {key: _on_host(value) for key, value in kwargs.items()}
        if name.startswith("gsmap."):
            result = _by_cpu_kernel(name, inner)
        else:
            result = _OWN_MATHS.get(func, func)(*inner, **options)
        if func in _READS:
            return result
        result = _on_gpu(result)
        if not on_gpu or name.startswith("gsmap.") or func in _OWN_MATHS:
            return result
        return return_and_correct_aliasing(func, args, kwargs, result)

    def _copied(self, source: Tensor, kwargs: dict[str, Any]) -> Tensor:
        """Copy a tensor to another type or device."""
        target = kwargs.get("device")
        kind = torch.device(target).type if target is not None else source.device.type
        waits = not kwargs.get("non_blocking")
        options = {k: v for k, v in kwargs.items() if k not in ("device", "pin_memory")}
        if not isinstance(source, PretendedTensor):
            if waits:
                self._wait("upload")
            self._launch("upload")
            copy = aten._to_copy.default(source, **options)
            return PretendedTensor(copy.clone() if copy is source else copy)
        if kind == "cpu":
            if waits:
                self._wait("download")
            self._launch("download")
            return aten._to_copy.default(source.host, **options)
        dtype = kwargs.get("dtype") or source.dtype
        self._launch(f"cast {str(source.dtype)[6:]} to {str(dtype)[6:]}")
        return PretendedTensor(aten._to_copy.default(source.host, **options))

    def _copied_into(self, target: Tensor, source: Tensor, non_blocking: bool = False) -> Tensor:
        """Copy values into a tensor."""
        from_gpu, into_gpu = (isinstance(t, PretendedTensor) for t in (source, target))
        name = "copy_" if from_gpu and into_gpu else "upload" if into_gpu else "download"
        if name != "copy_" and not non_blocking:
            self._wait(name)
        self._launch(name)
        inner = [t.host if isinstance(t, PretendedTensor) else t for t in (target, source)]
        aten.copy_.default(*inner)
        return target

    def _check_devices(self, func: Any, name: str, args: Any, tensors: list[Tensor]) -> None:
        """Refuse tensors of two devices, as a GPU does; numbers and some indices may differ."""
        if func not in _INDEXING:
            if any(t.dim() and not isinstance(t, PretendedTensor) for t in tensors):
                raise RuntimeError(
                    "Expected all tensors to be on the same device, but found at least two "
                    f"devices, {DEVICE} and cpu! ({name})"
                )
            return
        if not isinstance(args[0], PretendedTensor):
            raise RuntimeError(f"indices should be on the device of what is indexed, cpu ({name})")
        indices = [index for index in args[1] if index is not None]
        for index in indices:
            if not isinstance(index, PretendedTensor):
                self._wait("upload of an index")
                self._launch("upload")
        if any(index.dtype in (torch.bool, torch.uint8) for index in indices):
            self._wait("boolean index")

    def _part_of_gradient(self) -> str:
        """Return the part whose gradient is computed."""
        node = torch._C._current_autograd_node()
        if node is None or "AccumulateGrad" in node.name():
            return "backward: sums"
        after = bisect.bisect_right(self._marks, node._sequence_nr(), key=lambda mark: mark[0])
        return f"backward: {self._marks[after - 1][1] or 'rest'}" if after else "backward: rest"

    def _launch(self, name: str, times: int = 1) -> None:
        self.launches[self._part, name] += times

    def _wait(self, reason: str) -> None:
        self.waits[self._part, reason, _line_of_project()] += 1


def _tensors_in(values: Iterable[Any]) -> Iterator[Tensor]:
    """Yield the tensors among an operation's arguments, which may be lists of tensors."""
    for value in values:
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, list | tuple):
            yield from _tensors_in(value)


def _on_host(value: Any) -> Any:
    """An argument of an operation with each pretended tensor replaced by its values."""
    if isinstance(value, PretendedTensor):
        return value.host
    if isinstance(value, list | tuple):
        return type(value)(_on_host(item) for item in value)
    return value


def _on_gpu(result: Any) -> Any:
    """The result of an operation with each tensor on the pretended GPU."""
    if isinstance(result, Tensor):
        return PretendedTensor(result)
    if isinstance(result, list | tuple):
        return type(result)(_on_gpu(item) for item in result)
    return result


def _line_of_project() -> str:
    """Return the innermost line outside of torch and of this file, as ``file:line``."""
    frame: FrameType | None = sys._getframe(2)
    while frame is not None:
        name = _name_of_file(frame.f_code.co_filename)
        if name is not None:
            return f"{name}:{frame.f_lineno}"
        frame = frame.f_back
    return "?"


@cache
def _name_of_file(file: str) -> str | None:
    """Short name of a file whose lines are waited for; None for those of torch and this one."""
    path = Path(file)
    if path.is_relative_to(ROOT) and "site-packages" not in path.parts:
        return str(path.relative_to(ROOT)) if path != Path(__file__) else None
    if any(part.startswith("mm") for part in path.parts):
        packages = path.parts[path.parts.index("site-packages") + 1 :]
        return "/".join(packages)
    return None


def _num_launches(name: str, args: Any) -> int:
    """Return how many kernels an operation is: those on lists take so many tensors at a time."""
    if not name.startswith(("_foreach", "_fused_adam", "_fused_sgd")):
        return 1
    lists = [arg for arg in args if isinstance(arg, list | tuple) and len(arg)]
    of_tensors = sum(isinstance(each[0], Tensor) for each in lists)
    most = _TENSORS_A_LAUNCH[min(max(of_tensors, 1), 5) - 1]
    return -(-len(args[0]) // most)


@contextlib.contextmanager
def _flag(set_flag: Callable[[bool], None]) -> Iterator[None]:
    """Set a flag of torch that is off by default, for a while."""
    set_flag(True)
    try:
        yield
    finally:
        set_flag(False)


@contextlib.contextmanager
def _replaced(owner: Any, name: str, value: Any) -> Iterator[None]:
    """Replace an attribute for a while."""
    before = getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        setattr(owner, name, before)


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
    """Attend as torch does, on the pretended GPU by the kernel that a GPU takes with a mask."""
    if not isinstance(query, PretendedTensor):
        return _plain_attention(query, key, value, attn_mask, dropout_p, is_causal, **kwargs)
    if attn_mask is not None:
        if attn_mask.dtype == torch.bool:
            zeros = torch.zeros_like(attn_mask, dtype=query.dtype)
            attn_mask = zeros.masked_fill_(attn_mask.logical_not(), float("-inf"))
        attn_mask = attn_mask.expand(*query.shape[:3], key.shape[2])
    return aten._scaled_dot_product_efficient_attention(
        query, key, value, attn_mask, torch.is_grad_enabled(), dropout_p, is_causal
    )[0]


def _attention_weights(query: Tensor, key: Tensor, bias: Tensor | None, scale: float) -> Tensor:
    logits = (query @ key.transpose(-1, -2)) * scale
    return (logits if bias is None else logits + bias).softmax(-1)


def _efficient_attention(
    query: Tensor, key: Tensor, value: Tensor, bias: Tensor | None, *_: Any, **options: Any
) -> tuple[Tensor, ...]:
    """Attention, by plain maths and without dropout, and placeholders of what its kernel keeps."""
    scale = options.get("scale") or query.shape[-1] ** -0.5
    weights = _attention_weights(query.float(), key.float(), bias, scale)
    attended = (weights @ value.float()).to(query.dtype)
    number = torch.zeros((), dtype=torch.long)
    return attended, query.new_zeros(query.shape[:3], dtype=torch.float32), number, number.clone()


def _efficient_attention_backward(
    grad: Tensor,
    query: Tensor,
    key: Tensor,
    value: Tensor,
    bias: Tensor | None,
    *_: Any,
    **options: Any,
) -> tuple[Tensor, ...]:
    """The gradients of `_efficient_attention` in query, key and value; a mask has none."""
    scale = options.get("scale") or query.shape[-1] ** -0.5
    weights = _attention_weights(query, key, bias, scale)
    grad_weights = grad @ value.transpose(-1, -2)
    grad_logits = weights * (grad_weights - (grad_weights * weights).sum(-1, keepdim=True)) * scale
    in_bias = torch.empty(0) if bias is None else torch.zeros_like(bias)
    in_key = grad_logits.transpose(-1, -2) @ query
    return grad_logits @ key, in_key, weights.transpose(-1, -2) @ grad, in_bias


_OWN_MATHS: dict[Any, Callable[..., Any]] = {
    aten._scaled_dot_product_efficient_attention.default: _efficient_attention,
    aten._scaled_dot_product_efficient_attention_backward.default: _efficient_attention_backward,
}


def _sampled(value: Tensor, locations: Tensor, weights: Tensor, *shape: int) -> Tensor:
    height, width = shape
    sampled = deformable_sample(value, (height, width), locations, weights, "reference")
    return sampled.unflatten(2, (weights.shape[2], -1))


def _sampled_kernels(
    value: Tensor, uv: Tensor, weights: Tensor, seen: Tensor, offsets: Tensor, *settings: Any
) -> Tensor:
    *shape, bilinear = settings
    return sample_kernels_reference(value, tuple(shape), uv, seen, weights, offsets, bilinear)


# operators that have no kernel for the CPU, differentiable in their first three tensors
_REFERENCES: dict[str, Callable[..., Tensor]] = {
    "deformable_sample": _sampled,
    "sample_kernels": _sampled_kernels,
}


def _by_cpu_kernel(name: str, args: Any) -> Any:
    """Compute one of the project's operators by what serves the CPU."""
    inputs = [arg.detach() if isinstance(arg, Tensor) else arg for arg in args[:-1]]
    function = name.removeprefix("gsmap.")
    reference = _REFERENCES.get(function.removesuffix("_backward"))
    if reference is None:
        plain = getattr(torch.ops.gsmap, function.replace("_in_warps", ""))
        return plain(*inputs, "cpu")
    if not function.endswith("_backward"):
        return reference(*inputs)

    def gradients() -> list[Tensor]:
        leaves = [tensor.requires_grad_() for tensor in inputs[1:4]]
        result = reference(*leaves, *inputs[4:])
        return list(torch.autograd.grad(result, leaves, inputs[0], materialize_grads=True))

    with ThreadPoolExecutor(1) as thread:  # autograd is off below this mode
        return thread.submit(gradients).result()
