"""Mistakes of a model that the comparison with the reference must notice."""

from collections.abc import Iterator
from contextlib import contextmanager

from torch import Tensor

from reference.golden import Golden
from reference.registry import run_checks


@contextmanager
def shifted(parameter: Tensor, offset: float) -> Iterator[None]:
    """Make a parameter of a shared model wrong, for a while."""
    right = parameter.detach().clone()
    parameter.data += offset
    try:
        yield
    finally:
        parameter.data.copy_(right)


def missed(golden: Golden, files: str) -> set[str]:
    """Return the quantities that do not agree."""
    golden.forget_outputs()
    try:
        return {row.quantity for row in run_checks(golden, files) if not row.passed}
    finally:
        golden.forget_outputs()
