"""Cases that Triton's kernels are tested on, in the interpreter and on a GPU, against float64."""

from unittest import mock

import gaussian_cases
import pytest
import torch
from raster_loss_cases import MASKS, SETTINGS

from gsmap.ops import backends
from gsmap.ops.deformable_sampling import deformable_sample
from gsmap.ops.gaussian_raster import render_gaussians
from gsmap.ops.kernel_sampling import sample_kernels
from gsmap.ops.polyline_raster import draw_polylines, soft_rasters
from gsmap.ops.raster_loss import raster_loss
from gsmap.structures.grid import BEVGrid

CASES = {}  # kernel -> name of a case -> check of a device


def case(kernel, *variants):
    """Register a check, called with the device and a variant's arguments."""

    def register(check):
        cases = CASES.setdefault(kernel, {})
        for variant in variants or ((),):
            name = " ".join([check.__name__, *map(str, variant)])
            cases[name] = lambda device, variant=variant: check(device, *variant)
        return check

    return register


def run():
    """Run the cases of all kernels in Triton's interpreter, on the CPU."""
    torch.set_num_threads(1)
    for kernel, checks in CASES.items():
        for name, check in checks.items():
            try:
                check("cpu")
            except Exception as error:
                raise AssertionError(f"case {name!r} of {kernel}") from error


def values_and_gradients(function, leaves, upstream):
    """Return the result of a function, and the gradients in its floating-point arguments."""
    leaves = [leaf.detach().requires_grad_(leaf.is_floating_point()) for leaf in leaves]
    out = function(*leaves)
    wanted = [leaf for leaf in leaves if leaf.requires_grad]
    grads = torch.autograd.grad(out, wanted, upstream.to(out), materialize_grads=True)
    return out.detach().cpu(), [grad.cpu() for grad in grads]


def compare(function, leaves, device, shape):
    """Assert that ``function(backend, *leaves)`` gives the reference's values and gradients.

    Values of size 1 are sums of up to some hundred float32 products, hence 1e-5; gradients are
    compared as whole tensors. A gradient in half precision has its three (bfloat16: two) digits.
    """
    upstream = torch.randn(shape, generator=torch.Generator().manual_seed(1))
    on_device = [leaf.to(device) for leaf in leaves]
    out, grads = values_and_gradients(lambda *x: function("triton", *x), on_device, upstream)
    exact = [leaf.double() if leaf.is_floating_point() else leaf for leaf in leaves]
    true, true_grads = values_and_gradients(
        lambda *x: function("reference", *x), exact, upstream.double()
    )
    assert out.dtype == torch.float32
    assert out.shape == true.shape == torch.Size(shape)
    torch.testing.assert_close(out, true.float(), atol=1e-5, rtol=1e-5)
    floating = [leaf for leaf in leaves if leaf.is_floating_point()]
    for leaf, grad, true_grad in zip(floating, grads, true_grads, strict=True):
        assert grad.dtype == leaf.dtype
        limit = 5e-3 if leaf.dtype != torch.float32 else 2e-5
        assert (grad.double() - true_grad).norm() <= limit * true_grad.norm()


def deformable_problem(shape, channels, samples, queries=9, spread=1.6, dtype=torch.float32):
    """Return a map of two samples with three heads, locations around its middle, and weights."""
    generator = torch.Generator().manual_seed(0)
    cells = shape[0] * shape[1]
    value = torch.randn(2, cells, 3, channels, generator=generator).to(dtype)
    locations = torch.rand(2, queries, 3, samples, 2, generator=generator) - 0.5
    weights = torch.randn(2, queries, 3, samples, generator=generator) / samples**0.5
    return value, locations * spread + 0.5, weights


@case(
    "deformable_sample",
    ((21, 33), 32, 1),
    ((21, 33), 8, 20),
    ((5, 7), 6, 3),  # channels are no power of two
    ((1, 1), 4, 2),
    ((3, 2), 600, 1, 2),  # a row is more than a block
    ((21, 33), 32, 2, 0),  # no query
    ((21, 33), 4, 4, 9, 20.0),  # far off: nearly all outside
    ((21, 33), 4, 4, 9, 1e-3),  # all within a cell
    ((21, 33), 16, 4, 9, 1.6, torch.bfloat16),
    ((21, 33), 20, 4, 9, 1.6, torch.float16),
)
def equals_float64(device, shape, channels, samples, *further):
    problem = deformable_problem(shape, channels, samples, *further)
    compare(
        lambda backend, *leaves: deformable_sample(leaves[0], shape, *leaves[1:], backend=backend),
        problem,
        device,
        (*problem[2].shape[:2], 3 * channels),
    )


@case("deformable_sample")
def takes_any_strides(device):
    value, locations, weights = (x.to(device) for x in deformable_problem((5, 7), 8, 3))
    turned = (
        value.permute(3, 2, 1, 0).contiguous().permute(3, 2, 1, 0),
        locations.transpose(1, 3).contiguous().transpose(1, 3),
        weights[..., None].expand(-1, -1, -1, -1, 2)[..., 1],
    )
    upstream = torch.randn(2, 9, 24)

    def sample(*leaves):
        return deformable_sample(leaves[0], (5, 7), *leaves[1:], backend="triton")

    plain = values_and_gradients(sample, (value, locations, weights), upstream)
    strided = values_and_gradients(sample, turned, upstream.mT.contiguous().mT)
    torch.testing.assert_close(strided, plain)


@case("deformable_sample")
def poisons_rows_of_locations_that_are_not_numbers_alone(device):
    value, locations, weights = deformable_problem((5, 7), 6, 3)
    clean = deformable_sample(value, (5, 7), locations, weights, "reference").unflatten(-1, (3, 6))
    locations[0, 3, 1, 2, 0] = float("nan")
    locations[1, 2, 0, 0] = float("inf")
    poisoned = torch.zeros(2, 9, 3, 6, dtype=torch.bool)
    poisoned[0, 3, 1] = poisoned[1, 2, 0] = True
    leaves = [x.to(device) for x in (value, locations, weights)]
    out, (in_value, *_) = values_and_gradients(
        lambda *x: deformable_sample(x[0], (5, 7), *x[1:], backend="triton"),
        leaves,
        torch.ones(2, 9, 18),
    )
    out = out.unflatten(-1, (3, 6))
    assert out[poisoned].isnan().all()
    torch.testing.assert_close(out[~poisoned], clean[~poisoned])
    assert in_value.isfinite().all()


@case("deformable_sample")
def works_twice_under_compile_and_autocast(device):
    leaves = [x.to(device).requires_grad_() for x in deformable_problem((5, 7), 8, 3)]

    def loss(value, locations, weights):
        scaled = value * 2
        out = deformable_sample(scaled, (5, 7), locations, weights, backend="triton")
        return out.square().sum()

    total = loss(*leaves)
    first = torch.autograd.grad(total, leaves, retain_graph=True)
    torch.testing.assert_close(torch.autograd.grad(total, leaves), first)
    compiled = torch.compile(loss, backend="aot_eager", fullgraph=True)
    torch.testing.assert_close(torch.autograd.grad(compiled(*leaves), leaves), first)
    with torch.autocast(device, torch.bfloat16):
        torch.testing.assert_close(torch.autograd.grad(loss(*leaves), leaves), first)


@case("deformable_sample")
def refuses_a_gradient_of_the_gradient(device):
    leaves = [x.to(device).requires_grad_() for x in deformable_problem((5, 7), 8, 3)]
    out = deformable_sample(leaves[0], (5, 7), *leaves[1:], backend="triton")
    grads = torch.autograd.grad(out.square().sum(), leaves, create_graph=True)
    with pytest.raises(RuntimeError, match="no autograd formula was registered"):
        torch.autograd.grad(grads[0].square().sum(), leaves)


def kernel_problem(shape, heads, channels, samples, queries=11, spread=1.2, dtype=torch.float32):
    """Return maps of 2 x 3 cameras, points, weights, flags and offsets of a kernel."""
    generator = torch.Generator().manual_seed(0)
    value = torch.randn(2, 3, shape[0] * shape[1], heads, channels, generator=generator).to(dtype)
    uv = (torch.rand(2, 3, queries, heads, 2, generator=generator) - 0.5) * spread + 0.5
    weights = torch.randn(2, queries, heads, samples, generator=generator) / samples**0.5
    seen = torch.rand(2, 3, queries, generator=generator) < 0.4
    seen[:, 0, : queries // 2] = False  # a program's cells are all unseen by a camera
    offsets = torch.randint(-2, 3, (samples, 2), generator=generator)
    return value, uv, weights, seen, offsets


def sample_kernels_by(backend, shape, bilinear):
    """Return `sample_kernels` with the tensors of `kernel_problem` as arguments."""

    def sample(value, uv, weights, seen, offsets):
        return sample_kernels(value, shape, uv, seen, weights, offsets, bilinear, backend)

    return sample


@case(
    "sample_kernels",
    (False, (21, 33), 2, 16, 1),
    (False, (21, 33), 4, 64, 15),
    (True, (21, 33), 8, 8, 3),
    (True, (5, 7), 3, 6, 20),  # neither heads nor channels nor the kernel are a power of two
    (False, (5, 7), 3, 6, 3),
    (False, (1, 1), 1, 4, 2),
    (True, (1, 1), 1, 4, 2),
    (False, (5, 7), 2, 4, 3, 0),  # no cell
    (False, (5, 7), 2, 4, 3, 5, 30.0),  # far off: moved to the border
    (True, (5, 7), 2, 4, 3, 5, 30.0),  # far off: nothing
    (True, (5, 7), 2, 4, 3, 5, 1e-3),  # all at one place
    (False, (5, 7), 2, 20, 3, 5, 1.2, torch.bfloat16),
    (True, (5, 7), 2, 20, 3, 5, 1.2, torch.float16),
)
def kernels_equal_float64(device, bilinear, shape, heads, channels, samples, *further):
    problem = kernel_problem(shape, heads, channels, samples, *further)
    compare(
        lambda backend, *leaves: sample_kernels_by(backend, shape, bilinear)(*leaves),
        problem,
        device,
        (*problem[2].shape[:3], channels),
    )


@case("sample_kernels")
def rounds_half_to_even_as_torch_does(device):
    """Points between pixels, k / 2 of a pixel apart, beyond the border, too; exact in binary."""
    steps = torch.arange(-6, 40) / 2
    uv = torch.stack([steps / 16, steps / 8], -1)[None, None, :, None]  # (1, 1, Q, 1, 2)
    value = torch.arange(8 * 16).float().view(1, 1, -1, 1, 1)
    seen = torch.ones(1, 1, len(steps), dtype=torch.bool)
    problem = value, uv, torch.ones(1, len(steps), 1, 1), seen, torch.tensor([[1, -2]])
    expected = sample_kernels_by("reference", (8, 16), False)(*problem)
    out = sample_kernels_by("triton", (8, 16), False)(*(x.to(device) for x in problem))
    assert torch.equal(out.cpu(), expected)
    assert len(expected.unique()) > 20


@case("sample_kernels", (False,), (True,))
def ignores_what_is_not_seen(device, bilinear):
    problem = kernel_problem((5, 7), 3, 6, 3)
    upstream = torch.randn(2, 11, 3, 6)
    sample = sample_kernels_by("triton", (5, 7), bilinear)
    clean = values_and_gradients(sample, [x.to(device) for x in problem], upstream)
    for value in (float("nan"), -1e30):
        problem[1][~problem[3]] = value
        other = values_and_gradients(sample, [x.to(device) for x in problem], upstream)
        torch.testing.assert_close(other, clean)


def in_warps(yes=True):
    """Let `render_gaussians` take the kernels that have a warp a tile, or the others."""
    kernels = {"render_gaussians_in_warps"} if yes else set()
    return mock.patch.object(backends, "AUTO_KERNELS", kernels)


@case("render_gaussians", *((name,) for name in gaussian_cases.CASES))
def masks_equal_float64_in_warps(device, name):
    with in_warps():
        gaussian_cases.compare_with_reference(name, "triton", device)


@case("render_gaussians", (False,), (True,))
def masks_of_nothing(device, warps):
    with in_warps(warps):
        for shape in ((0, 4), (3, 0)):
            empty = torch.zeros(*shape, 2), torch.ones(*shape, 2), torch.zeros(shape)
            masks = render_gaussians(
                *(x.to(device) for x in empty), gaussian_cases.ODD_GRID, "triton"
            )
            assert masks.shape == (shape[0], 21, 33)
            assert not masks.any()


@case("render_gaussians", (False,), (True,))
def one_parameter_that_is_not_a_number_shows_in_all_of_its_mask(device, warps):
    grid, upstream = BEVGrid((-15, 15), (-30, 30), 11, 17), torch.ones(5, 11, 17)
    problem = gaussian_cases.random_gaussians(5, 35, 0.3, 0.5)
    for n, values in enumerate([problem[0][..., 0], problem[0][..., 1], problem[1][..., 0]]):
        values[n, 34 - n] = float("nan")
    problem[2][3, 20] = float("nan")
    with in_warps(warps):
        masks, grads = gaussian_cases.render_with_gradients(
            problem, grid, "triton", upstream, device
        )
    assert masks[:4].isnan().all()
    assert masks[4].isfinite().all()
    for grad in grads:
        assert grad[4].isfinite().all()
    assert grads[0][:4].isnan().flatten(1).any(1).all()


def loss_by(backend, settings, normalize, target):
    """Return the loss of predictions by a backend."""
    return lambda pred: raster_loss(
        pred, target.to(pred), normalize=normalize, backend=backend, **settings
    )


@case(
    "raster_loss",
    *((name, 0, "both") for name in MASKS),
    ("dense", 1, "foreground"),
    ("sparse", 3, "pixels"),
)
def losses_equal_float64(device, name, number, normalize):
    pred, target = MASKS[name]
    upstream = torch.tensor([1.0, -0.5])
    out, (grad,) = values_and_gradients(
        loss_by("triton", SETTINGS[number], normalize, target), [pred.to(device)], upstream
    )
    true, (true_grad,) = values_and_gradients(
        loss_by("reference", SETTINGS[number], normalize, target), [pred.double()], upstream
    )
    # sums of some hundred float32 terms of size 1, as of the kernels on a CPU
    torch.testing.assert_close(out, true.float(), atol=1e-6, rtol=1e-5)
    assert (grad - true_grad).norm() <= 1e-5 * true_grad.norm()


@case("raster_loss")
def losses_of_nothing_and_of_equal_masks(device):
    loss = loss_by("triton", {}, "both", torch.zeros(0, 4, 5))
    out, (grad,) = values_and_gradients(loss, [torch.zeros(0, 4, 5).to(device)], torch.zeros(0))
    assert out.shape == (0,)
    assert grad.shape == (0, 4, 5)
    masks = MASKS["both empty"][0]
    out, (grad,) = values_and_gradients(
        loss_by("triton", {}, "both", masks), [masks.to(device)], torch.ones(2)
    )
    assert not out.any()
    assert grad.isfinite().all()


@case("raster_loss")
def losses_repeat_bit_by_bit_and_twice(device):
    pred, target = (x.to(device) for x in MASKS["dense"])
    leaf = pred.requires_grad_()
    loss = loss_by("triton", {}, "both", target)
    out = loss(leaf)
    first = torch.autograd.grad(out.sum(), leaf, retain_graph=True)[0]
    assert torch.equal(first, torch.autograd.grad(out.sum(), leaf)[0])
    assert torch.equal(out, loss(leaf))


def random_vertices(count, spread=1.0):
    """Return three polylines over and around 21 x 33 pixels, and which are polygons."""
    generator = torch.Generator().manual_seed(0)
    vertices = torch.rand(3, count, 2, generator=generator) * torch.tensor([40.0, 25.0]) - 3
    middle = torch.tensor([16.0, 10.0])
    kinds = torch.tensor([True, False, False])
    return (vertices - middle) * spread + middle, kinds


@case(
    "soft_rasters",
    (1, "squared"),
    (2, "plain"),
    (9, "squared"),
    (17, "plain"),  # 34 edges: more than a number has bits
    (4, "squared", 5.0),  # far off
    (4, "plain", 1e-2),  # tiny
    (3, "squared", 0.0),  # single points
)
def soft_rasters_equal_float64(device, count, distance, spread=1.0):
    vertices, kinds = random_vertices(count, spread)
    upstream = torch.randn(3, 21, 33, generator=torch.Generator().manual_seed(1))

    def render(backend):
        return lambda v: soft_rasters(
            v, 21, 33, kinds.to(v.device), distance=distance, backend=backend
        )

    out, (grad,) = values_and_gradients(render("triton"), [vertices.to(device)], upstream)
    true, (true_grad,) = values_and_gradients(render("reference"), [vertices.double()], upstream)
    # pixels are up to 40 away at a float32 spacing of 4e-6
    torch.testing.assert_close(out, true.float(), atol=1e-5, rtol=0)
    # a line's way back is 0.01 off: of tiny lines, float32 has it to a ten-thousandth alone
    limit = 1e-4 if spread < 1 else 2e-5
    assert (grad - true_grad).norm() <= limit * true_grad.norm()


@case("soft_rasters")
def soft_rasters_with_a_vertex_a_hair_beside_a_row(device):
    hair = float(torch.nextafter(torch.tensor(1.0), torch.tensor(2.0)))
    ring = torch.tensor([[[3.0, 100.0], [20.0, hair], [18.0, -5.0], [3.0, -5.0]]])
    kinds = torch.tensor([True])
    out = soft_rasters(ring.to(device), 8, 32, is_polygon=kinds.to(device), backend="triton")
    true = soft_rasters(ring.double(), 8, 32, is_polygon=kinds, backend="reference")
    torch.testing.assert_close(out.cpu(), true.float(), atol=1e-5, rtol=0)


@case("soft_rasters")
def soft_rasters_of_nothing_and_of_no_numbers(device):
    empty = torch.zeros(0, 20, 2, device=device, requires_grad=True)
    masks = soft_rasters(empty, 7, 9, backend="triton")
    masks.sum().backward()
    assert masks.shape == (0, 7, 9)
    assert empty.grad.shape == (0, 20, 2)
    vertices, kinds = random_vertices(4)
    vertices[0, 2, 1], vertices[1, 3, 0] = float("nan"), float("inf")
    out, (grad,) = values_and_gradients(
        lambda v: soft_rasters(v, 9, 9, kinds.to(device), backend="triton"),
        [vertices.to(device)],
        torch.ones(3, 9, 9),
    )
    assert out[:2].isnan().all()
    assert out[2:].isfinite().all()
    assert grad[:2].isnan().all()
    assert grad[2:].isfinite().all()


@case("draw_polylines", (2, 0.6, 1.0), (9, 0.6, 1.0), (20, 3.0, 1.0), (4, 0.6, 3.0), (3, 0.6, 0.0))
def drawings_equal_float64(device, count, width_m, spread):
    grid = BEVGrid((-15, 15), (-30, 30), 41, 33)
    vertices, filled = random_vertices(count, spread)
    lines = (vertices - torch.tensor([17.0, 9.5])) * torch.tensor([0.9, 2.8])
    mask = draw_polylines(lines.to(device), grid, width_m, filled.to(device), backend="triton")
    exact = draw_polylines(lines.double(), grid, width_m, filled, backend="reference")
    # pixels are up to 40 m away at a float32 spacing of 4e-6 m, and 1.2 m wide
    torch.testing.assert_close(mask.cpu(), exact.float(), atol=1e-5, rtol=0)


@case("draw_polylines")
def drawings_of_nothing_and_of_no_numbers(device):
    grid = BEVGrid((-15, 15), (-30, 30), 9, 5)
    empty = torch.zeros(0, 20, 2, device=device)
    assert draw_polylines(empty, grid, backend="triton").shape == (0, 9, 5)
    lines, _ = random_vertices(4)
    lines[1, 3, 0] = float("nan")
    mask = draw_polylines(lines.to(device), grid, backend="triton")
    assert mask[1].isnan().all()
    assert mask[[0, 2]].isfinite().all()
