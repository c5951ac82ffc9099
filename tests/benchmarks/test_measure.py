import argparse
import platform
import time

import pytest
import torch

from benchmarks import raster
from benchmarks.measure import MIB, Cost, in_own_process, markdown_table, measure
from gsmap.structures.grid import BEVGrid

CPU = torch.device("cpu")
needs_proc = pytest.mark.skipif(platform.system() != "Linux", reason="reads /proc")


def one_after_the_other() -> None:
    for _ in range(2):
        torch.ones(64 * MIB)


def together() -> tuple[torch.Tensor, torch.Tensor]:
    return torch.ones(64 * MIB), torch.ones(64 * MIB)


def wait() -> None:
    time.sleep(0.5)


@needs_proc
def test_peak_is_what_a_call_had_in_use_at_once():
    """Two tensors of 256 MiB, one after the other: 256 MiB; both kept: 512 MiB.

    In a process of its own: what ran before decides whether freed pages go back at once.
    """
    one, two = (
        in_own_process(measure, function, CPU, 1).peak_bytes / MIB
        for function in (one_after_the_other, together)
    )
    # beside the tensors: pages that the process touches, and Linux counts pages in lumps
    assert abs(one - 256) < 64
    assert abs(two - 512) < 64


@needs_proc
def test_waiting_takes_wall_time_and_no_processor_time():
    """In a process of its own, whose other threads have nothing to do."""
    cost = in_own_process(measure, wait, CPU, 2)
    assert cost.wall_s >= 0.5
    assert cost.cpu_s < 0.4
    assert cost.time_s(CPU) == cost.cpu_s


def test_cost_scales_with_the_work():
    assert Cost(1.0, 2.0, 30).scale(1.5) == Cost(1.5, 3.0, 45)


def test_table():
    assert markdown_table(("a", "b"), [(1, "x")]) == "| a | b |\n| --- | --- |\n| 1 | x |\n"


def test_floor_counts_the_pixels_of_the_ellipse():
    """Two Gaussians of 1 m: radius sqrt(2 ln 1e6) = 5.257 m, so 86.8 pixels of 1 m each."""
    grid = BEVGrid((0, 40), (0, 40), 40, 40)
    means = torch.tensor([[[10.0, 10.0], [30.0, 30.0]]])
    pixels = raster.ellipse_pixels((means, torch.ones(1, 2, 2), torch.zeros(1, 2)), grid)
    assert abs(pixels - 2 * 86.8) < 8  # the circle's rim crosses about 40 pixels


@needs_proc
def test_command_writes_its_tables(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(raster, "SIZES", ((16, 8),))
    monkeypatch.setattr(raster, "SCALES_M", ((1.0, 0.4),))
    monkeypatch.setattr(raster, "TRAINING_SIZE", (16, 8))
    monkeypatch.setattr(raster, "RATE_REPEATS", 1)
    parser = argparse.ArgumentParser()
    raster.add_arguments(parser)
    out = tmp_path / "table.md"
    threads = torch.get_num_threads()
    args = parser.parse_args(f"--instances 8 --repeats 1 --threads 1 --out {out}".split())
    raster.run(args)
    torch.set_num_threads(threads)
    text = out.read_text()
    assert "| 16 x 8 | 1 x 0.4 |" in text
    assert "| draw 2 ground truths |" in text
    assert text in capsys.readouterr().out
