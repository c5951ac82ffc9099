"""What the numba kernels share: an exponential that vectorises, and threads over instances.

Numba's cache watches the file of a kernel alone: delete ``__pycache__`` after a change here.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from itertools import pairwise

import numpy as np
import torch

HAS_NUMBA = find_spec("numba") is not None
SERIAL_BELOW = 1 << 16  # pixels; starting a thread costs about as much as filling so many

# Associative sums may be split into vector lanes (always in the same way, so results repeat);
# NaN and infinity keep their meaning.
FASTMATH = {"reassoc", "contract", "nsz", "arcp"}


def is_fused(backend: str, tensor: torch.Tensor) -> bool:
    """Tell whether the fused CPU kernels are wanted and serve a tensor.

    Args:
        backend: ``"reference"``, ``"cpu"``, or ``"auto"``: the kernels where they serve.
        tensor: What they are to work on.

    Raises:
        ValueError: If ``backend`` is unknown, or ``"cpu"`` and the kernels do not serve.
    """
    if backend not in ("auto", "reference", "cpu"):
        raise ValueError(f"backend must be 'auto', 'reference' or 'cpu', got {backend!r}.")
    serves = HAS_NUMBA and tensor.device.type == "cpu" and tensor.dtype == torch.float32
    if backend == "cpu" and not serves:
        raise ValueError(
            "backend 'cpu' needs numba and float32 tensors on the CPU, "
            f"got {tensor.dtype} on {tensor.device}: use 'auto'."
        )
    return serves and backend != "reference"


def run_in_threads(kernel: Callable[[int, int], None], count: int, pixels: int) -> None:
    """Call ``kernel(first, last)`` on slices of ``range(count)``, one per torch thread.

    Each instance is worked on by one thread from start to end, so the result does not depend on
    the number of threads. Threads live for one call: nothing survives into a forked process, and
    calls from several Python threads (torch's autograd engine) cannot meet.

    Args:
        kernel: Releases the GIL; works on instances ``first`` to ``last - 1``.
        count: Number of instances.
        pixels: Number of pixels per instance.
    """
    workers = min(torch.get_num_threads(), count)
    if workers <= 1 or count * pixels < SERIAL_BELOW:
        if count:
            kernel(0, count)
        return
    bounds = [round(i * count / workers) for i in range(workers + 1)]
    with ThreadPoolExecutor(workers - 1) as pool:
        jobs = [pool.submit(kernel, *pair) for pair in pairwise(bounds[1:])]
        kernel(bounds[0], bounds[1])
        for job in jobs:
            job.result()


def exp2_coefficients(degree: int = 5) -> tuple[np.float32, ...]:
    """Coefficients of 2^x on [-0.5, 0.5], lowest power first, relative error about 1e-7."""
    nodes = np.polynomial.chebyshev.chebpts1(64) / 2
    fit = np.polynomial.Polynomial.fit(nodes, np.exp2(nodes), degree, w=1 / np.exp2(nodes))
    return tuple(np.float32(c) for c in fit.convert().coef)
