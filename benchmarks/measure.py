"""Time and peak memory of a function, on the CPU and on a GPU, and markdown tables."""

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
M_MMAP_THRESHOLD = -3  # of glibc's mallopt


@dataclass(frozen=True)
class Cost:
    """What a call costs.

    Args:
        wall_s: Shortest wall-clock time of a call in seconds.
        cpu_s: Shortest processor time of a call, all threads together, in seconds.
        peak_bytes: Highest memory in use during a call, beyond what was in use before.
    """

    wall_s: float
    cpu_s: float
    peak_bytes: int

    def time_s(self, device: torch.device) -> float:
        """Return the processor time on the CPU, where other work disturbs the clock, else wall."""
        return self.cpu_s if device.type == "cpu" else self.wall_s

    def scaled(self, factor: float) -> "Cost":
        """Return the cost of ``factor`` times as much of the same work."""
        return Cost(self.wall_s * factor, self.cpu_s * factor, int(self.peak_bytes * factor))


def measure(function: Callable[[], object], device: torch.device, repeats: int = 5) -> Cost:
    """Measure a function's peak memory once, after a first call, then its shortest times.

    Args:
        function: Called without arguments; its result is dropped.
        device: Where it works: on ``cuda`` every timing waits for the device.
        repeats: Number of timed calls.

    Raises:
        RuntimeError: If the system does not tell a process's peak memory (only Linux, with glibc,
            does).
    """
    function()
    peak = _peak_bytes(function, device)
    wall, cpu = float("inf"), float("inf")
    for _ in range(repeats):
        _wait_for(device)
        wall_start, cpu_start = time.perf_counter(), time.process_time()
        function()
        _wait_for(device)
        wall = min(wall, time.perf_counter() - wall_start)
        cpu = min(cpu, time.process_time() - cpu_start)
    return Cost(wall, cpu, peak)


def in_own_process(function: Callable[..., Result], *arguments: object) -> Result:
    """Call a function in a fresh process: what others left in memory does not count there."""
    # one worker would be this process; of two, a single task starts but one
    (result,) = ordered_map(partial(_call, function), [arguments], workers=2, timeout_s=None)
    return result


def _call(function: Callable[..., Result], arguments: tuple[object, ...]) -> Result:
    return function(*arguments)


def _wait_for(device: torch.device) -> None:
    """Let a GPU finish."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def _peak_bytes(function: Callable[[], object], device: torch.device) -> int:
    """Call a function and return its peak memory beyond what was in use."""
    gc.collect()
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        function()
        return torch.cuda.max_memory_allocated(device) - before
    if platform.system() != "Linux":
        raise WorkError("Peak memory on the CPU is read from /proc, which only Linux has.")
    libc = ctypes.CDLL(None)
    libc.mallopt(M_MMAP_THRESHOLD, 64 * 1024)  # tensors go back to the system when they are freed,
    libc.malloc_trim(0)  # as memory kept for reuse would hide the next use or add to it
    Path("/proc/self/clear_refs").write_text("5")  # resets the peak
    before = _status_bytes("VmRSS")
    function()
    libc.mallopt(M_MMAP_THRESHOLD, 32 * MIB)  # what glibc arrives at by itself
    return max(_status_bytes("VmHWM") - before, 0)


def _status_bytes(field: str) -> int:
    """Read a size from this process's status."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field + ":"):
            return int(line.split()[1]) * 1024
    raise WorkError(f"/proc/self/status has no {field}.")


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Lay out a table in markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(str(cell) for cell in line) + " |" for line in lines) + "\n"


def publish(report: str, out: Path | None) -> None:
    """Print a report, and write it to a file if there shall be one."""
    print(report)
    if out:
        out.write_text(report + "\n")
