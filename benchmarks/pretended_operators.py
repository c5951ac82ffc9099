"""Operators on the pretended GPU: which of them launch a kernel or wait, and their CPU versions.

The pretended GPU (`benchmarks.pretended_gpu`) computes on the CPU. It counts the kernels that would
be launched on a GPU, and how often the host would wait for the GPU.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch
from torch import Tensor

from gsmap.ops.deformable_sampling import deformable_sample
from gsmap.ops.kernel_sampling.reference import sample_kernels_reference

aten = torch.ops.aten

# Operations that launch no kernel. Views launch none either, but they are not listed: the schema of
# an operation shows whether its result is a view.
FREE = {
    aten.detach.default,
    aten.alias.default,
    aten.lift_fresh.default,
    aten.lift.default,
    aten.empty.memory_format,
    aten.empty_strided.default,
    aten.empty_like.default,
    aten.new_empty.default,
    aten.new_empty_strided.default,
    aten.resize_.default,
    aten._unsafe_view.default,
    aten._reshape_alias.default,
    aten.set_.source_Tensor,
    aten.is_same_size.default,
    aten.sym_size.int,
}
# Operations that make the host wait, because it reads their result or its size from the GPU.
WAITS = {
    aten._local_scalar_dense.default,
    aten.is_nonzero.default,
    aten.equal.default,
    aten.nonzero.default,
    aten.masked_select.default,
    aten.bincount.default,
    aten._unique2.default,
    aten.unique_consecutive.default,
    aten.unique_dim.default,
    aten._linalg_check_errors.default,
}
# Operations whose result is a Python number or bool, not a tensor of the pretended GPU.
READS = {aten._local_scalar_dense.default, aten.is_nonzero.default, aten.equal.default}
# Operations whose second argument is a list of indices, which may be on the CPU.
INDEXING = {
    aten.index.Tensor,
    aten.index_put.default,
    aten.index_put_.default,
    aten._index_put_impl_.default,
    aten._unsafe_index.Tensor,
}


def _attention_weights(query: Tensor, key: Tensor, bias: Tensor | None, scale: float) -> Tensor:
    """Softmax of the scaled logits. (B, heads, N, K)"""
    logits = (query @ key.transpose(-1, -2)) * scale
    if bias is not None:
        logits = logits + bias
    return logits.softmax(-1)


def _efficient_attention(
    query: Tensor, key: Tensor, value: Tensor, bias: Tensor | None, *_: Any, **options: Any
) -> tuple[Tensor, ...]:
    """Compute attention with matrix products, without dropout and without a causal mask.

    The operation also takes the settings of these two; they are ignored.

    Args:
        query: Queries. (B, heads, N, C)
        key: Keys. (B, heads, K, C)
        value: Values. (B, heads, K, C)
        bias: Values to add to the logits, or None. (B, heads, N, K)
        options: ``scale`` of the logits, by default 1 / sqrt(C).

    Returns:
        Weighted sums of the values (B, heads, N, C), and zeros in place of the three other results
        of the GPU's kernel: the log-sums of the softmax, and the seed and the offset of the random
        generator.
    """
    scale = options.get("scale") or query.shape[-1] ** -0.5
    weights = _attention_weights(query.float(), key.float(), bias=bias, scale=scale)
    result = (weights @ value.float()).to(query.dtype)
    log_sums = query.new_zeros(query.shape[:3], dtype=torch.float32)
    seed = torch.zeros((), dtype=torch.long)
    offset = torch.zeros((), dtype=torch.long)
    return result, log_sums, seed, offset


def _efficient_attention_backward(
    grad: Tensor,
    query: Tensor,
    key: Tensor,
    value: Tensor,
    bias: Tensor | None,
    *_: Any,
    **options: Any,
) -> tuple[Tensor, ...]:
    """Compute the gradients of `_efficient_attention`. The gradient of the bias is set to 0.

    The operation also takes the results of the forward pass; they are ignored and computed again.

    Args:
        grad: Gradient of the result. (B, heads, N, C)
        query: Queries. (B, heads, N, C)
        key: Keys. (B, heads, K, C)
        value: Values. (B, heads, K, C)
        bias: Values added to the logits, or None. They are an attention mask, whose gradient is not
            needed. (B, heads, N, K)
        options: ``scale`` of the logits, by default 1 / sqrt(C).

    Returns:
        Gradients in the shapes of query, key, value and bias.
    """
    scale = options.get("scale") or query.shape[-1] ** -0.5
    weights = _attention_weights(query, key, bias=bias, scale=scale)
    grad_weights = grad @ value.transpose(-1, -2)
    # The gradient of a softmax w is w * (g - sum(g * w)). The scaling of the logits multiplies it.
    grad_logits = weights * (grad_weights - (grad_weights * weights).sum(-1, keepdim=True)) * scale
    grad_query = grad_logits @ key
    grad_key = grad_logits.transpose(-1, -2) @ query
    grad_value = weights.transpose(-1, -2) @ grad
    grad_bias = torch.empty(0) if bias is None else torch.zeros_like(bias)
    return grad_query, grad_key, grad_value, grad_bias


# Functions that replace the operations of torch without a kernel for the CPU.
REPLACEMENTS: dict[Any, Callable[..., Any]] = {
    aten._scaled_dot_product_efficient_attention.default: _efficient_attention,
    aten._scaled_dot_product_efficient_attention_backward.default: _efficient_attention_backward,
}


def _sample_deformably(
    value: Tensor, locations: Tensor, weights: Tensor, height: int, width: int
) -> Tensor:
    """Compute the operator ``deformable_sample`` by its reference."""
    result = deformable_sample(value, (height, width), locations, weights, backend="reference")
    num_heads = weights.shape[2]
    return result.unflatten(2, (num_heads, -1))  # the operator's result has an axis of heads


def _sample_kernels(
    value: Tensor,
    uv: Tensor,
    weights: Tensor,
    visible: Tensor,
    offsets: Tensor,
    height: int,
    width: int,
    bilinear: bool,
) -> Tensor:
    """Compute the operator ``sample_kernels`` by its reference."""
    shape = (height, width)
    return sample_kernels_reference(value, shape, uv, visible, weights, offsets, bilinear)


# References of the project's operators without a kernel for the CPU, by the name of the operator.
# Their first three arguments are the tensors that have gradients.
_REFERENCES: dict[str, Callable[..., Tensor]] = {
    "deformable_sample": _sample_deformably,
    "sample_kernels": _sample_kernels,
}


def run_cpu_kernel(name: str, args: Any) -> Any:
    """Compute one of the project's operators by its kernel for the CPU or by its reference.

    Args:
        name: Name of the operator, with the prefix ``gsmap.``.
        args: Arguments on the CPU; the last one is the backend.

    Returns:
        Result of the operator. For a ``_backward`` operator, this is a list of gradients.
    """
    inputs = [arg.detach() if isinstance(arg, Tensor) else arg for arg in args[:-1]]
    operator = name.removeprefix("gsmap.")
    reference = _REFERENCES.get(operator.removesuffix("_backward"))
    if reference is None:
        # The operator NAME_in_warps is a GPU variant of the operator NAME.
        kernel = getattr(torch.ops.gsmap, operator.replace("_in_warps", ""))
        return kernel(*inputs, "cpu")
    if not operator.endswith("_backward"):
        return reference(*inputs)
    # The first argument of a backward operator is the gradient of the result.
    upstream, *inputs = inputs

    def gradients() -> list[Tensor]:
        # The inputs are detached above, so that the tensors of the caller are not changed.
        leaves = [tensor.requires_grad_() for tensor in inputs[:3]]
        result = reference(*leaves, *inputs[3:])
        # An input without influence on the result gets a gradient of zeros instead of None.
        grads = torch.autograd.grad(result, leaves, grad_outputs=upstream, materialize_grads=True)
        return list(grads)

    # Autograd is off inside of the dispatch mode of `PretendedGPU`. The gradients are computed in
    # another thread, because the mode does not apply there.
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(gradients).result()
