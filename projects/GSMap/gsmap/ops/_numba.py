"""Helpers of the numba kernels: ranges of pixels, and threads over instances.

Numba's cache notices changes of the file of a kernel only. Delete ``__pycache__`` after a change of
this file.
"""

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch
from numba import njit
from torch import Tensor

import gsmap.utils.compilation  # noqa: F401 - logs that kernels are compiled

SERIAL_BELOW = 1 << 16  # pixels; starting a thread costs about as much as filling this many

# Options of the compiler. With "reassoc", a sum may be reordered, so that it is computed in vector
# lanes. The order is fixed when a kernel is compiled, so that results are repeatable. The others
# allow fused multiply-add, any sign of zero, and multiplication by a reciprocal in place of a
# division. Options under which NaN and infinity lose their meaning are left out.
FASTMATH = {"reassoc", "contract", "nsz", "arcp"}


def run_in_threads(kernel: Callable[..., None], pixels: int, *arguments: Any) -> None:
    """Run a kernel on slices of the instances, one slice per torch thread.

    Kernels are compiled with ``nogil``, so Python threads run them in parallel.

    One thread computes an instance from start to end, so the result does not depend on the number
    of threads. Threads are started for each call and end with it. A forked process therefore never
    inherits a dead thread pool, and callers in several Python threads, such as the threads of
    torch's autograd engine, do not wait for a shared one.

    Args:
        kernel: Called as ``kernel(*arguments, first, last)`` for the instances ``first`` to
            ``last - 1``.
        pixels: Number of pixels of an instance.
        *arguments: Arguments of the kernel. The length of the first one is the number of instances.
            A tensor becomes an array, and an output must be a contiguous tensor.
    """
    arrays = []
    for argument in arguments:
        is_tensor = isinstance(argument, Tensor)
        arrays.append(argument.contiguous().numpy() if is_tensor else argument)
    count = len(arrays[0])

    def run(first: int, last: int) -> None:
        kernel(*arrays, first, last)

    if count == 0:
        return
    workers = min(torch.get_num_threads(), count)
    if workers <= 1 or count * pixels < SERIAL_BELOW:
        run(0, count)
        return
    bounds = [round(i * count / workers) for i in range(workers + 1)]
    with ThreadPoolExecutor(workers - 1) as pool:
        jobs = [pool.submit(run, bounds[i], bounds[i + 1]) for i in range(1, workers)]
        run(bounds[0], bounds[1])  # the first slice, in the calling thread
        for job in jobs:
            job.result()  # raises the error of a slice


@njit(inline="always")
def pixel_range(low, high, origin, step, size):  # type: ignore[no-untyped-def]
    """Find the pixels whose centres lie in an interval, along one axis of a raster.

    Args:
        low: Start of the interval, in the unit of the raster.
        high: End of the interval, included.
        origin: Coordinate of the raster's lower edge.
        step: Size of a pixel.
        size: Number of pixels along the axis.

    Returns:
        Index of the first pixel, and one past the index of the last.
    """
    # The centre of pixel i is at origin + (i + 0.5) * step.
    first = (low - origin) / step - 0.5
    last = (high - origin) / step - 0.5
    # `first` is limited to [0, size] and `last` to [-1, size - 1], so the range of an interval
    # outside of the raster is empty.
    start = math.ceil(min(max(first, 0.0), size))
    end = math.floor(max(min(last, size - 1.0), -1.0)) + 1
    return start, end
