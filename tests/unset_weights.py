"""Models whose weights have no initial values, for tests of structure and settings."""

from collections.abc import Iterator
from contextlib import contextmanager

from torch import Tensor
from torch.nn import init

RANDOM = (
    "kaiming_normal_",
    "kaiming_uniform_",
    "normal_",
    "trunc_normal_",
    "uniform_",
    "xavier_normal_",
    "xavier_uniform_",
)


def _keep(tensor: Tensor, *_: object, **__: object) -> Tensor:
    """Stand for a function of ``torch.nn.init``, and write nothing."""
    return tensor


@contextmanager
def unset_weights() -> Iterator[None]:
    """Build modules without random initial values.

    A model of published size then takes a tenth of the time: memory that is not written is never
    touched. Constants, such as zeros and values that a part computes, are written as always.
    """
    originals = {name: getattr(init, name) for name in RANDOM}
    for name in RANDOM:
        setattr(init, name, _keep)
    try:
        yield
    finally:
        for name, original in originals.items():
            setattr(init, name, original)
