"""Progress and compilation, told once in words where nobody watches."""

import logging

import numba

from gsmap.utils.compilation import NOTICE
from gsmap.utils.progress import Progress


def test_a_file_gets_a_line_at_the_start_and_one_at_the_end(capsys, monkeypatch):
    bar = Progress(range(500), desc="towns", unit="images")
    monkeypatch.setattr(bar, "_time", lambda: bar.start_t)  # however slow the machine is
    assert list(bar) == list(range(500))
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["towns: 0 of 500 images, 00:00", "towns: 500 of 500 images, 00:00"]


def test_a_total_that_is_not_known_yet_is_not_asked_for(capsys, monkeypatch):
    bar = Progress(unit="samples")
    monkeypatch.setattr(bar, "_time", lambda: bar.start_t)
    bar.total = 30
    bar.update(30)
    bar.close()
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["0 samples, 00:00", "30 of 30 samples, 00:00"]


def test_a_file_gets_a_line_each_minute(capsys, monkeypatch):
    now = iter(range(0, 10_000, 10))
    bar = Progress(total=30, unit="images")
    monkeypatch.setattr(bar, "_time", lambda: bar.start_t + next(now))
    for _ in range(30):
        bar.update()
    bar.close()
    done = [int(line.split()[0]) for line in capsys.readouterr().err.splitlines()]
    assert done[0] == 0
    assert done[-1] == 30
    assert 3 <= len(done) <= 8  # five minutes


def test_compilation_is_announced_once(monkeypatch, caplog):
    monkeypatch.setattr(NOTICE, "has_logged", False)
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            numba.njit(lambda x: x + 1)(1)
    assert caplog.text.count("Kernels for the CPU are compiled") == 1
