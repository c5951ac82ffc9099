"""Time and peak memory of a function on the CPU and on a GPU, and markdown tables."""

import ctypes
import gc
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

import torch

from gsmap.utils.errors import WorkError
from gsmap.utils.parallel import ordered_map

Result = TypeVar("Result")

MIB = 2**20
# Parameter of glibc's `mallopt`: smallest size in bytes of a block that malloc maps separately. The
# memory of such a block goes back to the system when the block is freed.
M_MMAP_THRESHOLD = -3


@dataclass(frozen=True)
class Cost:
    """Time and memory of a call.

    Attributes:
        wall_s: Shortest wall-clock time of a call in seconds.
        cpu_s: Shortest processor time of a call in seconds, summed over all threads.
        peak_bytes: Highest memory in use during a call, beyond the memory in use before it.
    """

    wall_s: float
    cpu_s: float
    peak_bytes: int

    def time_s(self, device: torch.device) -> float:
        """Time of a call in seconds: processor time on the CPU, and wall-clock time on a GPU.

        On the CPU, other processes would disturb the wall-clock time.
        """
        return self.cpu_s if device.type == "cpu" else self.wall_s

    def scale(self, factor: float) -> "Cost":
        """Cost of ``factor`` times the work, if time and memory grow in proportion."""
        return Cost(
            wall_s=self.wall_s * factor,
            cpu_s=self.cpu_s * factor,
            peak_bytes=int(self.peak_bytes * factor),
        )


def measure(function: Callable[[], object], device: torch.device, repeats: int = 5) -> Cost:
    """Measure the peak memory and the shortest times of a function.

    After a warm-up call, one call is measured for the memory, and ``repeats`` calls for the times.

    Args:
        function: Function without arguments; its result is dropped.
        device: Device of the work; on ``cuda`` every timing waits for the device.
        repeats: Number of timed calls, >= 1.

    Returns:
        Times and peak memory of a call.

    Raises:
        RuntimeError: If the system does not report the peak memory of a process (only Linux with
            glibc does).
    """
    function()  # warm-up
    peak = _peak_bytes(function, device)
    wall_times = []
    cpu_times = []
    for _ in range(repeats):
        _synchronize(device)
        wall_start = time.perf_counter()
        cpu_start = time.process_time()
        function()
        _synchronize(device)
        wall_times.append(time.perf_counter() - wall_start)
        cpu_times.append(time.process_time() - cpu_start)
    return Cost(wall_s=min(wall_times), cpu_s=min(cpu_times), peak_bytes=peak)


def in_own_process(function: Callable[..., Result], *arguments: object) -> Result:
    """Call a function in a fresh process, where earlier work has left nothing in memory.

    Args:
        function: Function that can be pickled.
        arguments: Positional arguments of the function.

    Returns:
        Result of the function.
    """
    # With one worker, `ordered_map` would run the task in this process. With two, it starts one
    # other process, since there is only one task. It yields one result, which is unpacked.
    call = partial(_call, function)
    (result,) = ordered_map(call, [arguments], workers=2, timeout_s=None)
    return result


def _call(function: Callable[..., Result], arguments: tuple[object, ...]) -> Result:
    """Call a function. Its arguments are one tuple, because a task is a single value."""
    return function(*arguments)


def _synchronize(device: torch.device) -> None:
    """Wait for the work of a GPU."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def _peak_bytes(function: Callable[[], object], device: torch.device) -> int:
    """Call a function and return its peak memory beyond the memory in use before it."""
    gc.collect()
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        function()
        return torch.cuda.max_memory_allocated(device) - before
    if platform.system() != "Linux":
        raise WorkError("Peak memory on the CPU is read from /proc, which only Linux has.")
    libc = ctypes.CDLL(None)  # the C library of this process
    # With this threshold, the memory of freed tensors goes back to the system. Otherwise, malloc
    # would keep it for reuse, and it would count as memory in use before the call.
    libc.mallopt(M_MMAP_THRESHOLD, 64 * 1024)
    libc.malloc_trim(0)
    Path("/proc/self/clear_refs").write_text("5")  # resets VmHWM to the memory in use
    before = _status_bytes("VmRSS")  # memory in use; VmHWM is its peak
    function()
    # From here on, malloc keeps the memory of freed tensors for reuse again, as in a normal run.
    # The first call of `mallopt` has ended glibc's automatic choice of the threshold. 32 MiB is the
    # largest threshold that glibc would choose.
    libc.mallopt(M_MMAP_THRESHOLD, 32 * MIB)
    # The counters of Linux are approximate, so the difference may be slightly negative.
    return max(_status_bytes("VmHWM") - before, 0)


def _status_bytes(field: str) -> int:
    """Read a size in bytes from the status of this process."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field + ":"):  # such as "VmRSS:   12345 kB", in units of 1024 bytes
            return int(line.split()[1]) * 1024
    raise WorkError(f"/proc/self/status has no {field}.")


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Format a table in markdown.

    Args:
        header: Names of the columns.
        rows: Cells of each row.

    Returns:
        Lines of the table, each with a line break.
    """
    text = ""
    for cells in (header, ["---"] * len(header), *rows):
        text += "| " + " | ".join(map(str, cells)) + " |\n"
    return text


def publish(report: str, out: Path | None) -> None:
    """Print a report, and write it to the file ``out`` if one is given."""
    print(report)
    if out:
        out.write_text(report + "\n")
