"""What the numba kernels share: ranges of pixels, and threads over instances.

Numba's cache watches the file of a kernel alone: delete ``__pycache__`` after a change here.
"""

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import torch
from numba import njit
from torch import Tensor

import gsmap.utils.compilation  # noqa: F401 - says that kernels are compiled

SERIAL_BELOW = 1 << 16  # pixels; starting a thread costs about as much as filling so many

# Associative sums may be split into vector lanes (always in the same way, so results repeat);
# NaN and infinity keep their meaning.
FASTMATH = {"reassoc", "contract", "nsz", "arcp"}


def run_in_threads(kernel: Callable[..., None], pixels: int, *arguments: Any) -> None:
    """Call ``kernel(*arguments, first, last)`` on slices of the instances, one a torch thread.

    The kernel works on instances ``first`` to ``last - 1`` of its first argument, each from start
    to end in one thread, so the result does not depend on the number of threads. A tensor becomes
    an array; one that is written to must be contiguous. Threads live for one call: nothing survives
    into a forked process, and calls from several Python threads (torch's autograd engine) cannot
    meet.
    """
    arrays = [a.contiguous().numpy() if isinstance(a, Tensor) else a for a in arguments]
    count = len(arrays[0])
    workers = min(torch.get_num_threads(), count)
    if workers <= 1 or count * pixels < SERIAL_BELOW:
        if count:
            kernel(*arrays, 0, count)
        return
    bounds = [round(i * count / workers) for i in range(workers + 1)]
    with ThreadPoolExecutor(workers - 1) as pool:
        jobs = [pool.submit(kernel, *arrays, *pair) for pair in pairwise(bounds[1:])]
        kernel(*arrays, bounds[0], bounds[1])
        for job in jobs:
            job.result()


@njit(inline="always")
def pixel_range(low, high, origin, step, size):  # type: ignore[no-untyped-def]
    """Return the first and one past the last of the pixels whose centres lie in [low, high]."""
    first, last = (low - origin) / step - 0.5, (high - origin) / step - 0.5
    return math.ceil(min(max(first, 0.0), size)), math.floor(max(min(last, size - 1.0), -1.0)) + 1
