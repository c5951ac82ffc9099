import math
import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from gaussian_cases import (
    CASES,
    ODD_GRID,
    compare_with_reference,
    random_gaussians,
    render_with_gradients,
)
from processes import run_python

from benchmarks.measure import in_own_process, measure
from gsmap.ops import backends, gaussian_raster
from gsmap.ops.gaussian_raster import render_gaussians
from gsmap.ops.polyline_raster import draw_polylines
from gsmap.ops.raster_loss import raster_loss
from gsmap.ops.soft_iou import pairwise_soft_iou
from gsmap.structures.grid import BEVGrid
from gsmap.utils.cli import end_process

BACKENDS = ["reference", "cpu"]
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")


def unit_grid(height, width):
    return BEVGrid((0, width), (0, height), height, width)


@pytest.mark.parametrize("backend", BACKENDS)
def test_peak_and_one_sigma_values_of_one_gaussian(backend):
    gaussian = torch.tensor([[2.5, 1.5]]), torch.ones(1, 2), torch.zeros(1)
    raster = render_gaussians(*gaussian, unit_grid(4, 5), backend)
    assert raster.shape == (4, 5)
    torch.testing.assert_close(
        raster[1, 3], torch.tensor(math.exp(-0.5))
    )  # one sigma from the mean
    torch.testing.assert_close(raster[1, 2], torch.tensor(1 - 1e-6))


@pytest.mark.parametrize("backend", BACKENDS)
def test_rotation_is_anticlockwise_from_x(backend):
    """A long Gaussian turned by 45 degrees covers the pixel up and right, not down and right."""
    gaussian = torch.tensor([[2.5, 2.5]]), torch.tensor([[2.0, 0.5]]), torch.tensor([math.pi / 4])
    raster = render_gaussians(*gaussian, unit_grid(5, 5), backend)
    torch.testing.assert_close(raster[3, 3], torch.tensor(math.exp(-0.5 * 2 / 4)))
    torch.testing.assert_close(raster[1, 3], torch.tensor(math.exp(-0.5 * 2 * 4)))


@pytest.mark.parametrize("backend", BACKENDS)
def test_two_gaussians_combine_as_independent_occupancies(backend):
    gaussians = torch.tensor([[0.5, 0.5], [2.5, 0.5]]), torch.ones(2, 2), torch.zeros(2)
    raster = render_gaussians(*gaussians, unit_grid(1, 3), backend)
    one = 1 - math.exp(-0.5)
    torch.testing.assert_close(raster[0, 1], torch.tensor(1 - one * one))


@pytest.mark.usefixtures("poisoned_empty")
@pytest.mark.parametrize("case", CASES)
def test_cpu_backend_equals_float64_reference(case):
    compare_with_reference(case, "cpu")


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("shape", [(0, 4), (3, 0), (2, 3, 5)])
def test_any_leading_shape(backend, shape):
    means = torch.zeros(*shape, 2, requires_grad=True)
    masks = render_gaussians(means, torch.ones(*shape, 2), torch.zeros(shape), ODD_GRID, backend)
    assert masks.shape == (*shape[:-1], 21, 33)
    masks.sum().backward()
    assert means.grad.shape == means.shape
    if shape == (3, 0):
        assert not masks.any()


def test_leading_dimensions_do_not_mix():
    gaussians = [value.reshape(2, 3, *value.shape[1:]) for value in random_gaussians(6, 4, 0.5, 3)]
    masks = render_gaussians(*gaussians, ODD_GRID, "cpu")
    single = render_gaussians(*(value[1, 2] for value in gaussians), ODD_GRID, "cpu")
    assert torch.equal(masks[1, 2], single)


def test_gradcheck_of_reference():
    gaussians = random_gaussians(2, 3, 1, 3, unit_grid(3, 4))
    leaves = [value.double().requires_grad_() for value in gaussians]
    assert torch.autograd.gradcheck(
        lambda *x: render_gaussians(*x, unit_grid(3, 4), "reference"), leaves
    )


@pytest.mark.parametrize("backend", BACKENDS)
def test_non_finite_parameters_show_in_their_own_mask_only(backend):
    means, scales, rotations = random_gaussians(2, 3, 0.5, 3)
    means[0, 1, 0] = torch.nan
    masks, grads = render_with_gradients(
        (means, scales, rotations), ODD_GRID, backend, torch.ones(2, 21, 33)
    )
    assert masks[0].isnan().all()
    assert masks[1].isfinite().all()
    assert grads[0][1].isfinite().all()
    assert grads[0][0].isnan().any()


def test_runs_and_thread_counts_give_the_same_bits():
    grid = BEVGrid((-15, 15), (-30, 30), 100, 50)
    gaussians = random_gaussians(40, 20, 0.2, 3, grid)
    upstream = torch.randn(40, 100, 50)
    threads, results = torch.get_num_threads(), []
    for count in (1, 1, 3):
        torch.set_num_threads(count)
        masks, grads = render_with_gradients(gaussians, grid, "cpu", upstream)
        results.append([masks, *grads])
    torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


CACHE_SCRIPT = """
import torch
from gaussian_cases import ODD_GRID, random_gaussians, render_with_gradients

torch.set_num_threads(1)
upstream = torch.randn(20, 21, 33, generator=torch.Generator().manual_seed(0))
_, grads = render_with_gradients(random_gaussians(20, 20, 0.3, 3), ODD_GRID, "cpu", upstream)
print([grad.double().abs().sum().item() for grad in grads])
"""


@pytest.mark.slow
def test_a_process_that_compiles_and_one_that_reads_the_cache_give_the_same_bits(tmp_path):
    paths = [str(Path(__file__).parent), str(Path(gaussian_raster.__file__).parents[3])]
    changes = {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": os.pathsep.join(paths)}
    command = [sys.executable, "-c", CACHE_SCRIPT]
    runs = [subprocess.check_output(command, env={**os.environ, **changes}) for _ in range(2)]
    assert runs[0] == runs[1]


@pytest.mark.skipif(platform.system() != "Linux", reason="peak memory is read from /proc")
@pytest.mark.parametrize("count", [1, 64])
def test_memory_is_that_of_the_masks_whatever_the_number_of_gaussians(count):
    # beside the masks (122 MiB): parameters in float64 and a mask per thread
    assert in_own_process(peak_of_rendering, 1600, count) < 1.5 * 4 * 1600 * 200 * 100


def peak_of_rendering(masks: int, count: int) -> int:
    """Return the peak memory of masks and their gradients, in bytes."""
    grid = BEVGrid((-15, 15), (-30, 30), 200, 100)
    leaves = [value.requires_grad_() for value in random_gaussians(masks, count, 0.2, 1, grid)]
    upstream = torch.ones(masks, 200, 100)

    def call():
        return torch.autograd.grad(render_gaussians(*leaves, grid, "cpu"), leaves, upstream)

    return measure(call, torch.device("cpu"), 1).peak_bytes


def test_second_backward_pass_gives_the_same_gradient():
    leaves = [value.requires_grad_() for value in random_gaussians(2, 5, 0.5, 3)]
    loss = render_gaussians(*leaves, ODD_GRID, "cpu").square().sum()
    first = torch.autograd.grad(loss, leaves, retain_graph=True)
    second = torch.autograd.grad(loss, leaves)
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_gradient_checkpointing_gives_the_same_gradient():
    leaves = [value.requires_grad_() for value in random_gaussians(2, 5, 0.5, 3)]

    def render(*gaussians):
        return render_gaussians(*gaussians, ODD_GRID, "cpu").square().sum()

    plain = torch.autograd.grad(render(*leaves), leaves)
    loss = torch.utils.checkpoint.checkpoint(render, *leaves, use_reentrant=False)
    again = torch.autograd.grad(loss, leaves)
    assert all(torch.equal(a, b) for a, b in zip(plain, again, strict=True))


@pytest.mark.parametrize("backend", BACKENDS)
def test_autocast_changes_nothing(backend):
    gaussians = random_gaussians(2, 5, 0.5, 3)
    plain = render_gaussians(*gaussians, ODD_GRID, backend)
    with torch.autocast("cpu", torch.bfloat16):
        mixed = render_gaussians(*gaussians, ODD_GRID, backend)
    assert mixed.dtype == torch.float32
    assert torch.equal(plain, mixed)


def test_half_precision_inputs_are_rendered_in_float32():
    gaussians = [value.bfloat16() for value in random_gaussians(2, 5, 0.5, 3)]
    masks = render_gaussians(*gaussians, ODD_GRID, "cpu")
    expected = render_gaussians(*(value.float() for value in gaussians), ODD_GRID, "cpu")
    assert masks.dtype == torch.float32
    assert torch.equal(masks, expected)
    mixed = gaussians[0].float(), gaussians[1], gaussians[2]
    assert torch.equal(render_gaussians(*mixed, ODD_GRID, "cpu"), expected)


def test_compiled_model_keeps_values_and_gradients():
    leaves = [value.requires_grad_() for value in random_gaussians(2, 5, 0.5, 3)]

    def model(means, scales, rotations):
        return render_gaussians(means * 1.1, scales.exp(), rotations, ODD_GRID).square().sum()

    expected = torch.autograd.grad(model(*leaves), leaves)
    # aot_eager traces forward and backward as the default compiler does, without a C++ compiler
    compiled = torch.compile(model, backend="aot_eager", fullgraph=True)
    actual = torch.autograd.grad(compiled(*leaves), leaves)
    torch.testing.assert_close(actual, expected)


def test_operator_is_well_formed():
    means, scales, rotations = random_gaussians(2, 3, 0.5, 3)
    gaussians = torch.cat([means, scales, rotations[..., None]], -1).requires_grad_()
    torch.library.opcheck(
        torch.ops.gsmap.render_gaussians.default,
        (gaussians, [-15.0, -30.0, 1.0, 2.0], 21, 33, "cpu"),
        test_utils=("test_schema", "test_faketensor", "test_autograd_registration"),
    )


TRITON_SCRIPT = """
import sys
import torch
from gaussian_cases import CASES, ODD_GRID, compare_with_reference, render_with_gradients
from gsmap.ops.gaussian_raster import render_gaussians
from gsmap.ops.soft_iou import pairwise_soft_iou

torch.set_num_threads(1)
for case in sys.argv[1:]:
    compare_with_reference(case, "triton")
preds, targets = torch.rand(3, 21, 77), torch.rand(2, 21, 77)  # more pixels than a block
iou = pairwise_soft_iou(preds, targets, backend="triton")
exact = pairwise_soft_iou(preds.double(), targets.double(), backend="reference")
torch.testing.assert_close(iou, exact.float())
assert pairwise_soft_iou(preds, targets[:0], backend="triton").shape == (3, 0)
upstream = torch.randn(2, 21, 33)
runs = [render_with_gradients(CASES["two"][0], ODD_GRID, "triton", upstream) for _ in range(2)]
assert torch.equal(runs[0][0], runs[1][0])
assert all(torch.equal(a, b) for a, b in zip(runs[0][1], runs[1][1], strict=True))
for shape in ((0, 4), (3, 0)):
    means = torch.zeros(*shape, 2, requires_grad=True)
    gaussians = means, torch.ones(*shape, 2), torch.zeros(shape)
    masks = render_gaussians(*gaussians, ODD_GRID, "triton")
    masks.sum().backward()
    assert masks.shape == (shape[0], 21, 33) and not masks.any()
    assert means.grad.shape == means.shape
"""


@pytest.mark.slow
def test_triton_kernels_equal_the_float64_reference_in_the_interpreter():
    """A process of its own: Triton reads ``TRITON_INTERPRET`` when it is imported."""
    pytest.importorskip("triton")
    paths = [str(Path(__file__).parent), str(Path(gaussian_raster.__file__).parents[3])]
    environment = {"TRITON_INTERPRET": "1", "PYTHONPATH": os.pathsep.join(paths)}
    result = run_python("-c", TRITON_SCRIPT, *CASES, env=environment)
    assert result.returncode == 0, result.stderr


@needs_gpu
@pytest.mark.parametrize("case", CASES)
def test_triton_backend_equals_float64_reference_on_a_gpu(case):
    compare_with_reference(case, "triton", "cuda")


@needs_gpu
def test_nothing_waits_for_a_gpu():
    leaves = [value.cuda().requires_grad_() for value in random_gaussians(2, 5, 0.5, 3)]
    render_gaussians(*leaves, ODD_GRID).sum().backward()  # compiles
    torch.cuda.set_sync_debug_mode("error")
    try:
        masks = render_gaussians(*leaves, ODD_GRID)
        targets = draw_polylines(leaves[0].detach(), ODD_GRID)
        pairwise_soft_iou(masks.detach(), targets)
        raster_loss(masks, targets).sum().backward()
    finally:
        torch.cuda.set_sync_debug_mode("default")


def test_triton_kernels_compile_for_a_gpu():
    """No GPU is needed to compile; a register spill would show as local memory."""
    pytest.importorskip("triton")
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource, compile

    from gsmap.ops.gaussian_raster import triton as gaussian_raster
    from gsmap.ops.soft_iou import triton as soft_iou

    def check_compiles(source):
        compiled = compile(source, target=GPUTarget("cuda", 80, 32), options={"num_warps": 4})
        assert compiled.asm["cubin"]
        assert ".local" not in compiled.asm["ptx"]

    sizes = {"count": "i32", "height": "i32", "width": "i32", "TILE": "constexpr"}
    frame = dict.fromkeys(("x_min", "y_min", "step_x", "step_y"), "fp32")
    for kernel, pointers in (
        (gaussian_raster.forward_kernel, ("gaussians", "masks")),
        (gaussian_raster.backward_kernel, ("gaussians", "grads", "moments")),
    ):
        signature = dict.fromkeys(pointers, "*fp32") | sizes | frame
        source = ASTSource(
            fn=kernel, signature=signature, constexprs={"TILE": gaussian_raster.TILE}
        )
        check_compiles(source)
    signature = dict.fromkeys(("preds", "targets", "minima"), "*fp32")
    check_compiles(
        ASTSource(
            fn=soft_iou.minima_kernel,
            signature=signature | {"pixels": "i32", "BLOCK": "constexpr"},
            constexprs={"BLOCK": soft_iou.BLOCK},
        )
    )


def _train_one_rank(rank, folder):
    """Take one rank's gradient through DistributedDataParallel and save it."""
    torch.distributed.init_process_group(
        "gloo", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=2
    )
    model = torch.nn.Linear(3, 5 * 5)
    torch.nn.init.constant_(model.weight, 0.1)
    parallel = torch.nn.parallel.DistributedDataParallel(model)
    values = parallel(torch.full((1, 3), float(rank + 1))).reshape(1, 5, 5)
    masks = render_gaussians(values[..., :2], values[..., 2:4].exp(), values[..., 4], ODD_GRID)
    masks.square().sum().backward()
    torch.save(model.weight.grad, f"{folder}/{rank}.pt")
    end_process(0)  # before DistributedDataParallel deletes the process group


@pytest.mark.slow
def test_gradients_are_averaged_over_ranks(tmp_path):
    torch.multiprocessing.spawn(_train_one_rank, (str(tmp_path),), nprocs=2)
    first, second = (torch.load(tmp_path / f"{rank}.pt") for rank in range(2))
    assert first.abs().sum() > 0
    assert torch.equal(first, second)


def test_without_numba_the_reference_renders_after_a_warning(monkeypatch):
    gaussians = random_gaussians(2, 5, 0.5, 3)
    monkeypatch.setitem(backends.INSTALLED, "cpu", False)
    with pytest.warns(UserWarning, match="pip install numba"):
        masks = render_gaussians(*gaussians, ODD_GRID)
    assert torch.equal(masks, render_gaussians(*gaussians, ODD_GRID, "reference"))
    with pytest.raises(ValueError, match="needs numba"):
        render_gaussians(*gaussians, ODD_GRID, "cpu")


def test_auto_renders_float64_in_float64():
    gaussians = [value.double() for value in random_gaussians(2, 5, 0.5, 3)]
    assert render_gaussians(*gaussians, ODD_GRID).dtype == torch.float64


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"backend": "cuda"}, "backend must be one of"),
        ({"means": torch.zeros(5, 3)}, r"means must have shape \(\.\.\., P, 2\)"),
        ({"scales": torch.ones(4, 2)}, r"scales must have shape \(5, 2\)"),
        ({"rotations": torch.ones(5, 1)}, r"rotations must have shape \(5,\)"),
        ({"rotations": torch.zeros(5, device="meta")}, "rotations must be on cpu"),
    ],
)
def test_bad_arguments_are_named(change, match):
    arguments = {
        "means": torch.zeros(5, 2),
        "scales": torch.ones(5, 2),
        "rotations": torch.zeros(5),
        "grid": ODD_GRID,
    }
    with pytest.raises(ValueError, match=match):
        render_gaussians(**{**arguments, **change})


def test_backends_refuse_what_they_cannot_compute():
    with pytest.raises(TypeError, match="scales must be floating point"):
        render_gaussians(
            torch.zeros(5, 2), torch.ones(5, 2, dtype=torch.long), torch.zeros(5), ODD_GRID
        )
    double = [value.double() for value in random_gaussians(1, 2, 1, 2)]
    with pytest.raises(ValueError, match="computes in float32"):
        render_gaussians(*double, ODD_GRID, "cpu")
