import argparse

import pytest
import torch
from processes import run_python

from benchmarks import kernels
from gsmap.ops import backends


def test_a_kernel_is_measured_in_the_interpreter(tmp_path):
    pytest.importorskip("triton")
    out = tmp_path / "kernels.md"
    command = ["-m", "benchmarks", "kernels", "--device", "cpu", "--reduced", "--out", out]
    result = run_python(*command, "--kernels", "deformable_sample", env={"TRITON_INTERPRET": "1"})
    assert result.returncode == 0, result.stderr
    assert "GSMAP_TRITON_KERNELS=deformable_sample (correct on this device)" in result.stdout
    assert out.read_text() == result.stdout
    assert out.read_text().count("| deformable_sample | ") == 4


def test_kernels_that_are_wrong_or_fail_are_named_and_the_others_measured(monkeypatch, capsys):
    def case(kernel, scale):
        def function(backend, x):
            if backend == "triton" and scale is None:
                raise RuntimeError("first line\nout of registers")
            return x * (scale if backend == "triton" else 1)

        return kernels.Case(kernel, "small", function, (torch.ones(3),))

    found = [case("raster_loss", 1.001), case("fails", None), case("deformable_sample", 1.0)]
    monkeypatch.setattr(kernels, "cases", lambda reduced: found)
    monkeypatch.setattr(backends, "AUTO_KERNELS", set())
    args = argparse.Namespace(device="cpu", reduced=True, kernels=None, out=None)
    with pytest.raises(SystemExit, match="error: wrong or failed: fails, raster_loss"):
        kernels.run(args)
    printed = capsys.readouterr().out
    assert "| fails | small | failed: RuntimeError: out of registers |" in printed
    assert "GSMAP_TRITON_KERNELS=deformable_sample (correct on this device)" in printed
