"""Constants on a device, and copies to it."""

import sys

import pytest
import torch

from gsmap.structures.tensors import cached_constant, constant, exclude_from_compile, upload


def test_nothing_is_copied_on_the_host():
    tensors = [torch.rand(3), torch.arange(4)]
    assert [a is b for a, b in zip(upload(tensors, torch.device("cpu")), tensors, strict=True)]


def test_constants_are_made_once():
    like = torch.zeros(1)
    assert constant(like, [1, 2]) is constant(like, (1, 2))
    assert constant(like, [1, 2]).dtype == torch.float32
    assert constant(like, [1, 2], torch.long).dtype == torch.long
    assert constant(like.double(), [[1, 2], [3, 4]]).shape == (2, 2)
    assert constant(like, 0.1) == torch.tensor(0.1)


def test_a_constant_made_in_inference_serves_a_training():
    like = torch.zeros(1)
    with torch.inference_mode():
        factor = constant(like, [3.0, 4.25])
        computed = cached_constant(
            like, ("test", torch.float32), lambda: like.new_tensor([2.0]).exp()
        )
    weight = torch.ones(2, requires_grad=True)
    (weight * factor * computed).sum().backward()
    torch.testing.assert_close(weight.grad, torch.tensor([3.0, 4.25]) * torch.tensor(2.0).exp())


def test_compilers_and_exporters_see_numbers_and_leave_nothing_behind():
    def scaled(x: torch.Tensor) -> torch.Tensor:
        return x * constant(x, [1.5, 987.0]) + cached_constant(
            x, ("sum", x.dtype), lambda: x.new_zeros(2) + 1
        )

    x = torch.tensor([2.0, 1.0])
    expected = torch.tensor([4.0, 988.0])
    compiled = torch.compile(scaled, backend="eager", fullgraph=True)
    torch.testing.assert_close(compiled(x), expected)

    class Net(torch.nn.Module):
        def forward(self, x: torch.Tensor) -> torch.Tensor:
            return scaled(x)

    exported = torch.export.export(Net(), (x,), strict=False)
    torch.testing.assert_close(exported.module()(x), expected)
    torch.testing.assert_close(torch.jit.trace(Net(), x)(x), expected)
    torch.testing.assert_close(scaled(x), expected)  # nothing of a trace was kept


def test_constants_are_bounded(monkeypatch):
    monkeypatch.setattr("gsmap.structures.tensors._MOST_CONSTANTS", 0)
    like = torch.zeros(1)
    assert constant(like, [0.123]) is not constant(like, [0.123])
    assert constant(like, [0.123]) == torch.tensor(0.123)


def test_a_function_that_is_left_as_it_is_never_meets_the_compiler(monkeypatch):
    """With the compiler and before it is imported, as part of what is compiled and alone."""
    seen = []

    @exclude_from_compile
    def noted(x: torch.Tensor, factor: float) -> torch.Tensor:
        seen.append(torch.compiler.is_compiling())
        return x * factor

    x = torch.tensor([2.0])
    monkeypatch.delitem(sys.modules, "torch._dynamo", raising=False)
    assert noted(x, 3.0) == 6.0
    monkeypatch.undo()
    compiled = torch.compile(lambda x: noted(x + 1, 2.0) - 1, backend="eager")
    assert [compiled(x).item() for _ in range(2)] == [5.0, 5.0]
    assert seen == [False, False, False]
    with pytest.raises(torch._dynamo.exc.Unsupported):
        torch.compile(lambda x: noted(x, 2.0), backend="eager", fullgraph=True)(x)
