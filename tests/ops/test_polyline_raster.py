import math

import pytest
import torch

from gsmap.ops.polyline_raster import draw_polylines, soft_rasters
from gsmap.structures.grid import BEVGrid

BACKENDS = ["reference", "cpu"]
METRE_GRID = BEVGrid((0, 5), (0, 4), 4, 5)  # pixels of 1 m


def yes(*flags):
    return torch.tensor(flags, dtype=torch.bool)


def random_vertices(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(6, count, 2, generator=generator) * torch.tensor([40.0, 25.0]) - 3


@pytest.mark.parametrize("backend", BACKENDS)
def test_line_covers_the_share_of_a_pixel_that_its_width_does(backend):
    """A line of 1 m at y = 1.75 covers 1.25 to 2.25: 3/4 of row 1 and 1/4 of row 2."""
    line = torch.tensor([[[-1.0, 1.75], [6.0, 1.75]]])
    mask = draw_polylines(line, METRE_GRID, width_m=1.0, backend=backend)
    expected = torch.tensor([0.0, 0.75, 0.25, 0.0])[:, None].expand(4, 5)
    torch.testing.assert_close(mask[0], expected)


@pytest.mark.parametrize("backend", BACKENDS)
def test_line_thinner_than_a_pixel_covers_its_width(backend):
    line = torch.tensor([[[-1.0, 1.5], [6.0, 1.5]]])
    mask = draw_polylines(line, METRE_GRID, width_m=0.2, backend=backend)
    torch.testing.assert_close(mask[0, 1], torch.full((5,), 0.2))
    assert not mask[0, [0, 2, 3]].any()


@pytest.mark.parametrize("backend", BACKENDS)
def test_ring_is_filled_or_outlined(backend):
    """A 3 m square around pixels (0..2, 1..3), drawn twice.

    . # # # .      . # # # .
    . # # # .      . # . # .
    . # # # .      . # # # .
    . . . . .      . . . . .
    """
    ring = torch.tensor([[1.0, 0.0], [4, 0], [4, 3], [1, 3], [1, 0]])
    filled = draw_polylines(ring[None], METRE_GRID, 1.0, yes(True), backend=backend)[0]
    expected = torch.zeros(4, 5)
    expected[:3, 1:4] = 1
    torch.testing.assert_close(filled, expected)
    outline = torch.tensor([[1.5, 0.5], [3.5, 0.5], [3.5, 2.5], [1.5, 2.5], [1.5, 0.5]])
    outlined = draw_polylines(outline[None], METRE_GRID, 1.0, yes(False), backend=backend)[0]
    assert outlined[1, 2] == 0
    assert (outlined[[0, 1, 2], [2, 1, 3]] == 1).all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_row_through_a_vertex_is_filled_once(backend):
    """Vertices are at the centres of rows, which rounding of their places may leave out."""
    grid = BEVGrid((-51.2, 51.2), (-51.2, 51.2), 512, 512)
    ring = torch.tensor([[[-10.0, -51.0], [10.0, -50.5], [5.0, -45.2], [-10.0, -45.0]]])
    mask = draw_polylines(ring, grid, filled=yes(True), backend=backend)
    exact = draw_polylines(ring.double(), grid, filled=yes(True), backend="reference")
    torch.testing.assert_close(mask, exact.float(), atol=1e-4, rtol=0)


@pytest.mark.usefixtures("poisoned_empty")
def test_fused_drawing_equals_the_float64_reference():
    grid = BEVGrid((-15, 15), (-30, 30), 41, 33)
    lines = (random_vertices(9) - torch.tensor([17.0, 9.5])) * torch.tensor([0.9, 2.8])
    filled = yes(True, False, True, False, False, True)
    mask = draw_polylines(lines, grid, 0.6, filled, backend="cpu")
    exact = draw_polylines(lines.double(), grid, 0.6, filled, backend="reference")
    # pixels are up to 40 m away at a float32 spacing of 4e-6 m
    torch.testing.assert_close(mask, exact.float(), atol=1e-5, rtol=0)


@pytest.mark.parametrize("backend", BACKENDS)
def test_no_polyline_gives_no_mask(backend):
    empty = torch.zeros(0, 20, 2)
    assert draw_polylines(empty, METRE_GRID, backend=backend).shape == (0, 4, 5)
    assert soft_rasters(empty, 7, 9, backend=backend).shape == (0, 7, 9)


@pytest.mark.parametrize("backend", BACKENDS)
def test_soft_line_falls_with_the_squared_distance(backend):
    line = torch.tensor([[[1.0, 2.0], [4.0, 2.0]]])
    mask = soft_rasters(line, 6, 9, line_softness=2.0, backend=backend)[0]
    # the way back, 0.01 pixel off, is nearer to pixels on its side
    torch.testing.assert_close(mask[2, 1:5], torch.ones(4))
    torch.testing.assert_close(mask[0, 3], torch.tensor(math.exp(-4 / 2)))
    torch.testing.assert_close(mask[4, 3], torch.tensor(math.exp(-(1.99**2) / 2)))
    torch.testing.assert_close(mask[2, 6], torch.tensor(math.exp(-(1.99**2 + 1e-4) / 2)))


@pytest.mark.parametrize("backend", BACKENDS)
def test_soft_polygon_is_a_sigmoid_of_the_signed_squared_distance(backend):
    square = torch.tensor([[[0.5, 0.5], [6.5, 0.5], [6.5, 6.5], [0.5, 6.5]]])
    mask = soft_rasters(square, 8, 9, yes(True), polygon_softness=4.0, backend=backend)[0]
    torch.testing.assert_close(mask[2, 3], torch.sigmoid(torch.tensor(1.5**2 / 4)))
    torch.testing.assert_close(mask[3, 8], torch.sigmoid(torch.tensor(-(1.5**2) / 4)))


@pytest.mark.parametrize("backend", BACKENDS)
def test_plain_distance_falls_as_the_paper_writes(backend):
    """exp(-D / tau) of a line, sigmoid(+-D / tau) of a polygon."""
    line = torch.tensor([[[1.0, 2.0], [4.0, 2.0]]])
    mask = soft_rasters(line, 6, 9, line_softness=2.0, distance="plain", backend=backend)[0]
    torch.testing.assert_close(mask[2, 1:5], torch.ones(4))
    torch.testing.assert_close(mask[0, 3], torch.tensor(math.exp(-2 / 2)))
    torch.testing.assert_close(mask[4, 3], torch.tensor(math.exp(-1.99 / 2)))
    square = torch.tensor([[[0.5, 0.5], [6.5, 0.5], [6.5, 6.5], [0.5, 6.5]]])
    mask = soft_rasters(square, 8, 9, yes(True), distance="plain", backend=backend)[0]
    torch.testing.assert_close(mask[2, 3], torch.sigmoid(torch.tensor(1.5 / 4)))
    torch.testing.assert_close(mask[3, 8], torch.sigmoid(torch.tensor(-1.5 / 4)))


@pytest.mark.parametrize("backend", BACKENDS)
def test_pixels_on_a_line_have_a_finite_gradient_in_the_plain_distance(backend):
    line = torch.tensor([[[1.0, 2.0], [4.0, 2.0]]], requires_grad=True)
    soft_rasters(line, 6, 9, distance="plain", backend=backend).sum().backward()
    assert torch.isfinite(line.grad).all()


@pytest.mark.usefixtures("poisoned_empty")
@pytest.mark.parametrize("distance", ["squared", "plain"])
@pytest.mark.parametrize("count", [1, 2, 9])
def test_fused_soft_rasters_equal_the_float64_reference(count, distance):
    vertices, kinds = random_vertices(count), yes(True, False, True, False, False, True)
    upstream = torch.randn(6, 21, 33, generator=torch.Generator().manual_seed(1))
    leaf, exact = vertices.clone().requires_grad_(), vertices.double().requires_grad_()
    mask = soft_rasters(leaf, 21, 33, kinds, distance=distance, backend="cpu")
    true = soft_rasters(exact, 21, 33, kinds, distance=distance, backend="reference")
    mask.backward(upstream)
    true.backward(upstream.double())
    torch.testing.assert_close(mask, true.float(), atol=1e-5, rtol=0)
    assert (leaf.grad - exact.grad).norm() < 1e-4 * exact.grad.norm()


@pytest.mark.parametrize("distance", ["squared", "plain"])
def test_gradcheck_of_soft_rasters(distance):
    vertices = (random_vertices(4, seed=3)[:2] / 5).double().requires_grad_()
    settings = {"distance": distance, "backend": "reference"}
    assert torch.autograd.gradcheck(
        lambda v: soft_rasters(v, 5, 6, yes(True, False), **settings), vertices
    )


def test_non_finite_vertices_show_in_their_own_mask_only():
    vertices = random_vertices(4)
    vertices[1, 2] = torch.nan
    mask = soft_rasters(vertices, 9, 9, backend="cpu")
    assert mask[1].isnan().all()
    assert mask[[0, 2, 3, 4, 5]].isfinite().all()


def test_compiled_model_keeps_the_gradient():
    vertices = random_vertices(4).requires_grad_()

    def model(v):
        return soft_rasters(v * 1.01, 9, 9).square().sum()

    (expected,) = torch.autograd.grad(model(vertices), vertices)
    compiled = torch.compile(model, backend="aot_eager", fullgraph=True)
    (actual,) = torch.autograd.grad(compiled(vertices), vertices)
    torch.testing.assert_close(actual, expected)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"polylines": torch.zeros(3, 1, 2)}, "P >= 2"),
        ({"width_m": 0.0}, "width_m must be > 0"),
        ({"filled": torch.zeros(2, dtype=torch.bool)}, r"filled must be bool of shape \(3,\)"),
        ({"backend": "cuda"}, "backend must be one of"),
        ({"polylines": torch.zeros(3, 4, 2).double(), "backend": "cpu"}, "computes in float32"),
    ],
)
def test_drawing_names_bad_arguments(change, match):
    arguments = {"polylines": torch.zeros(3, 4, 2), "grid": METRE_GRID}
    with pytest.raises(ValueError, match=match):
        draw_polylines(**{**arguments, **change})


def test_soft_rasters_name_bad_arguments():
    for kind in ("line_softness", "polygon_softness"):
        with pytest.raises(ValueError, match="softness must be > 0"):
            soft_rasters(torch.zeros(1, 3, 2), 4, 4, **{kind: 0.0})
    with pytest.raises(ValueError, match=r"distance must be one of .* got 'cubed'"):
        soft_rasters(torch.zeros(1, 3, 2), 4, 4, distance="cubed")
    with pytest.raises(ValueError, match=r"vertices must have shape \(n, V, 2\)"):
        soft_rasters(torch.zeros(3, 2), 4, 4)
    for shape in ((2, 3, 3), (2, 0, 2)):
        with pytest.raises(ValueError, match="vertices must have shape"):
            soft_rasters(torch.zeros(shape), 4, 4)
