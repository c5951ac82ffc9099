import os
from importlib import import_module
from pathlib import Path

import pytest
import torch
from processes import run_python
from triton_cases import CASES, deformable_problem
from triton_resources import find_ptxas, launches

import gsmap
from benchmarks import kernels
from gsmap.ops import backends
from gsmap.ops.deformable_sampling import deformable_sample, has_kernel

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
needs_ptxas = pytest.mark.skipif(not find_ptxas(), reason="needs the assembler of Triton's wheel")


@pytest.mark.timeout(1800)
def test_kernels_equal_the_float64_reference_in_the_interpreter():
    """A process of its own: Triton reads ``TRITON_INTERPRET`` when it is imported."""
    pytest.importorskip("triton")
    paths = [str(Path(__file__).parent), str(Path(gsmap.__file__).parents[1])]
    environment = {"TRITON_INTERPRET": "1", "PYTHONPATH": os.pathsep.join(paths)}
    result = run_python("-c", "import triton_cases; triton_cases.run()", env=environment)
    assert result.returncode == 0, result.stderr


@needs_gpu
@pytest.mark.parametrize(("kernel", "name"), [(k, name) for k in CASES for name in CASES[k]])
def test_kernels_equal_the_float64_reference_on_a_gpu(kernel, name):
    CASES[kernel][name]("cuda")


def call_deformable_sample(module, one):
    """As MapTR's decoder: 1,000 queries of 8 heads on 200 x 100 cells."""
    queries, heads, channels, samples = (1, 1, 1, 1) if one else (1000, 8, 32, 4)
    height, width = (1, 1) if one else (200, 100)
    value = torch.zeros(1, height * width, heads, channels)
    locations = torch.zeros(1, queries, heads, samples, 2)
    inputs = value, locations, torch.zeros(1, queries, heads, samples), height, width
    module.deformable_sample_backward(module.deformable_sample(*inputs), *inputs)


def call_sample_kernels(module, one):
    """As in MapTR's encoder: 200 x 100 cells, six cameras, 15 x 25 pixels."""
    views, queries, height, width = (1, 1, 1, 1) if one else (6, 20000, 15, 25)
    seen = torch.zeros(1, views, queries, dtype=torch.bool)
    for bilinear, heads, samples in ((False, 4, 15), (True, 8, 8)):
        heads, samples, channels = (1, 1, 1) if one else (heads, samples, 256 // heads)
        value = torch.zeros(1, views, height * width, heads, channels)
        uv = torch.zeros(1, views, queries, heads, 2)
        offsets = torch.zeros(samples, 2, dtype=torch.long)
        weights = torch.zeros(1, queries, heads, samples)
        inputs = value, uv, weights, seen, offsets, height, width, bilinear
        module.sample_kernels_backward(module.sample_kernels(*inputs), *inputs)


def call_render_gaussians(module, one):
    """As a step of four samples: 360 instances of 20 Gaussians on 200 x 100 pixels."""
    instances, count, height, width = (1, 1, 1, 1) if one else (360, 20, 200, 100)
    inputs = torch.zeros(instances, count, 5), [-15.0, -30.0, 0.3, 0.3], height, width
    module.render_gaussians_backward(module.render_gaussians(*inputs), *inputs)
    module.render_gaussians_in_warps_backward(module.render_gaussians_in_warps(*inputs), *inputs)


def call_raster_loss(module, one):
    """As a step of four samples: 360 masks of 200 x 100 pixels."""
    shape, taps = ((1, 1, 1), 1) if one else ((360, 200, 100), 11)
    inputs = torch.zeros(shape), torch.zeros(shape), torch.zeros(taps), 1.0
    module.raster_loss_sums_backward(module.raster_loss_sums(*inputs), *inputs)


def call_polyline_raster(module, one):
    """As a step of four samples: 360 lines of 20 points, there and back, on 200 x 100 pixels."""
    lines, count, height, width = (1, 1, 1, 1) if one else (360, 40, 200, 100)
    flags = torch.zeros(lines, dtype=torch.bool)
    for plain in (False, True):
        inputs = torch.zeros(lines, count, 2), flags, height, width, [2.0, 4.0], plain
        module.soft_rasters_backward(module.soft_rasters(*inputs), *inputs)
    frame = [-15.0, -30.0, 0.3, 0.3]
    module.draw_polylines(torch.zeros(lines, count, 2), flags, height, width, frame, 0.3, 0.3)


LAUNCHES = {
    "deformable_sampling": call_deformable_sample,
    "gaussian_raster": call_render_gaussians,
    "kernel_sampling": call_sample_kernels,
    "polyline_raster": call_polyline_raster,
    "raster_loss": call_raster_loss,
}


@needs_ptxas
@pytest.mark.parametrize("one", [False, True], ids=["published", "sizes of one"])
@pytest.mark.parametrize("folder", LAUNCHES)
def test_kernels_compile_for_hopper_without_spills(folder, one, monkeypatch):
    """A size of one is compiled in as a constant, which must fit wherever the number does."""
    module = import_module(f"gsmap.ops.{folder}.triton")
    found = launches(module, monkeypatch)
    LAUNCHES[folder](module, one)
    assert {name for name, *_ in found} == {n for n in vars(module) if n.endswith("_kernel")}
    for name, registers, spilled in found:
        print(f"{folder} {name}: {registers} registers, {spilled} bytes spilled")
        assert spilled == 0
        assert registers <= 128  # at least 16 of 64 warps at a time


@needs_gpu
@pytest.mark.parametrize("kernel", sorted(backends.TRITON_KERNELS.keys() - {"pairwise_soft_iou"}))
def test_kernels_are_captured_in_a_graph(kernel, monkeypatch):
    """Capture forbids waits, and memory from outside of the graph's pool."""
    monkeypatch.setattr(backends, "AUTO_KERNELS", {kernel})
    own = [case for case in kernels.cases(reduced=True) if case.kernel == kernel]
    assert own
    for case in own:
        inputs = [x.cuda() for x in case.inputs]
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            expected = kernels.results(case, "triton", inputs)
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            captured = kernels.results(case, "triton", inputs)
        graph.replay()
        torch.testing.assert_close(captured, expected)


def test_auto_takes_a_kernel_that_is_switched_on(monkeypatch):
    table = torch.zeros(0, device="meta")
    monkeypatch.setitem(backends.DEVICES, "triton", "meta")
    monkeypatch.setitem(backends.INSTALLED, "triton", True)
    monkeypatch.setattr(backends, "AUTO_KERNELS", {"render_gaussians"})
    assert not has_kernel(table)
    monkeypatch.setattr(backends, "AUTO_KERNELS", {"deformable_sample"})
    assert has_kernel(table)
    assert has_kernel(table.bfloat16())
    assert not has_kernel(table.double())
    torch.use_deterministic_algorithms(True)
    try:
        assert not has_kernel(table)
        with pytest.raises(ValueError, match="adds gradients up in any order: use 'reference'"):
            backends.choose_backend("triton", table, ("triton",), "deformable_sample")
    finally:
        torch.use_deterministic_algorithms(False)


def test_the_switch_names_kernels():
    trusted = {name for name, on in backends.TRITON_KERNELS.items() if on}
    assert backends.triton_kernels("") == trusted
    assert backends.triton_kernels(" deformable_sample,") == trusted | {"deformable_sample"}
    assert backends.triton_kernels("all") == set(backends.TRITON_KERNELS)
    with pytest.raises(ValueError, match=r"GSMAP_TRITON_KERNELS names \['rasters'\]"):
        backends.triton_kernels("rasters,deformable_sample")


def test_gradcheck_of_the_plain_deformable_sampling():
    leaves = [x.double().requires_grad_() for x in deformable_problem((3, 4), 2, 2, 2)]
    assert torch.autograd.gradcheck(
        lambda value, *places: deformable_sample(value, (3, 4), *places, "reference"), leaves
    )


def test_half_precision_is_summed_in_float32_by_every_backend():
    value, locations, weights = deformable_problem((5, 7), 6, 3, dtype=torch.bfloat16)
    out = deformable_sample(value, (5, 7), locations, weights)
    assert out.dtype == torch.float32
    expected = deformable_sample(value.float(), (5, 7), locations, weights)
    torch.testing.assert_close(out, expected, atol=0, rtol=0)


def test_an_unknown_backend_is_named():
    value, locations, weights = deformable_problem((5, 7), 6, 3)
    with pytest.raises(ValueError, match="does not serve tensors on cpu"):
        deformable_sample(value, (5, 7), locations, weights, "triton")
