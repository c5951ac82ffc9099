"""HDMapNet's head and encoder: layouts, learning, predictions on any encoder, bad settings."""

import numpy as np
import pytest
import torch
from mmdet3d.structures import Det3DDataSample
from mmengine.registry import init_default_scope

import gsmap.registered  # noqa: F401
from gsmap.apis.export import ExportedDetector
from gsmap.datasets.annotations.record import MapInstance
from gsmap.datasets.elements import elements_of_predictions
from gsmap.models.hdmapnet.decoder import LineMaps
from gsmap.models.hdmapnet.encoder import ViewTransformEncoder, sample_maps
from gsmap.models.hdmapnet.head import HDMapNetHead
from gsmap.models.hdmapnet.layout import metres_from_pixels, orient_forward, pixels_from_metres
from gsmap.models.hdmapnet.losses import LineMapLosses
from gsmap.models.hdmapnet.targets import MakeLineMaps
from gsmap.structures.grid import BEVGrid

LIDAR = BEVGrid((-6.0, 6.0), (-12.0, 12.0))  # x to the right, y ahead
EGO = BEVGrid((-12.0, 12.0), (-6.0, 6.0))  # x ahead, y to the left
LINES = [  # in the LiDAR's frame
    MapInstance(0, np.array([[-3.0, -11.0], [-3.0, 11.0]])),
    MapInstance(1, np.array([[3.0, -11.0], [3.0, 11.0]])),
]


def head(grid=LIDAR, **settings) -> HDMapNetHead:
    init_default_scope("mmdet3d")
    torch.manual_seed(0)
    own = {"embed_dims": 8, "pixel_m": 0.3, "decoder": {"base_channels": 8}}
    built = HDMapNetHead(grid, ("divider", "boundary"), **{**own, **settings})
    built.init_weights()
    return built


def sample(lines, grid=LIDAR, **settings) -> Det3DDataSample:
    own = {"num_classes": 2, "pixel_m": 0.3, "thickness_px": 3}
    results = {"map_instances": lines, "x_range": grid.x_range, "y_range": grid.y_range}
    made = MakeLineMaps(**{**own, **settings}).transform({"token": "token-0", **results})
    found = Det3DDataSample(metainfo={"token": "token-0"})
    found.gt_lines, found.gt_directions = made["gt_lines"], made["gt_directions"]
    return found


def test_both_frames_see_the_same_map():
    """A point 5 m ahead and 2 m to the left, in both frames."""
    in_lidar, in_ego = np.array([-2.0, 5.0]), np.array([5.0, 2.0])
    pixels = [
        pixels_from_metres(point, grid.rasterized(0.5))
        for point, grid in ((in_lidar, LIDAR), (in_ego, EGO))
    ]
    np.testing.assert_allclose(pixels, [[34.0, 16.0]] * 2)
    for point, grid in ((in_lidar, LIDAR), (in_ego, EGO)):
        grid = grid.rasterized(0.5)
        back = metres_from_pixels(pixels_from_metres(point, grid), grid)
        np.testing.assert_allclose(back, point)
        marked = torch.zeros(grid.height, grid.width)
        column, row = np.floor(grid.px_from_metres(point - 1e-6)).astype(int)
        marked[row, column] = 1
        seen = orient_forward(marked, grid)
        assert seen.shape == (24, 48)
        assert abs(seen.nonzero()[0].numpy()[::-1] + 0.5 - pixels[0]).max() <= 0.5


def test_targets_by_hand():
    found = sample(LINES)
    numbers, directions = found.gt_lines, found.gt_directions
    assert numbers.shape == (2, 40, 80)
    assert directions.shape == (2, 40, 80)
    assert numbers[0].unique().tolist() == [0, 1]
    assert numbers[1].unique().tolist() == [0, 2]
    rows = numbers[0].nonzero()[:, 0]
    # 3 m to the left is row 30; a line of thickness 3 covers 5 rows in OpenCV
    assert set(rows.tolist()) == {28, 29, 30, 31, 32}
    assert numbers[0].nonzero()[:, 1].min() <= 3
    assert directions[0][numbers[0] > 0].unique().tolist() == [1]  # ahead: 0 degrees
    assert directions[1][numbers[0] > 0].unique().tolist() == [19]
    assert not directions[:, (numbers == 0).all(0)].any()
    crossing = MapInstance(1, np.array([[-5.0, 0.0], [5.0, 0.0]]))
    gap = sample([crossing, LINES[0]], gap_px=9).gt_lines
    assert not gap[0, :, 36:45].any()  # the later class keeps its distance
    short = MapInstance(0, np.array([[0.0, 0.0], [0.0, 0.9]]))
    assert not sample([short]).gt_lines.any()


@pytest.mark.parametrize("lines", [[], LINES[:1], LINES])
def test_the_loss_falls_with_any_number_of_lines(lines):
    built = head()
    feats = torch.randn(1, 8, 40, 20, generator=torch.Generator().manual_seed(1))
    optimizer, totals = torch.optim.Adam(built.parameters(), 5e-3), []
    for _ in range(12):
        losses = built.loss({"bev_feats": feats}, [sample(lines)])
        total = sum(losses.values())
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        totals.append(float(total.detach()))
    assert set(losses) == {f"loss_{name}" for name in ("semantic", "pull", "push", "direction")}
    assert totals[-1] < 0.7 * totals[0]
    assert (losses["loss_direction"] > 0) == bool(lines)


def test_embeddings_by_hand():
    """Two instances: pixels at 0 and 2 (mean 1, each 1 away), and at 3 (alone)."""
    embedding = torch.tensor([[[0.0, 2.0, 3.0, 9.0]]])
    pull, push = LineMapLosses().embedding_losses(embedding, torch.tensor([[1, 1, 2, 0]]))
    assert float(pull) == pytest.approx((0.5**2 + 0) / 2)
    assert float(push) == pytest.approx((3.0 - 2.0) ** 2 / 2)
    none = LineMapLosses().embedding_losses(embedding, torch.zeros(1, 4, dtype=torch.long))
    assert [float(part) for part in none] == [0, 0]


@pytest.mark.parametrize("grid", [LIDAR, EGO])
def test_perfect_maps_become_the_lines_in_metres(grid):
    lines = LINES if grid is LIDAR else [
        MapInstance(e.label, np.stack([e.points[:, 1], -e.points[:, 0]], -1)) for e in LINES
    ]  # fmt: skip
    truth = sample(lines, grid)
    classes = torch.cat([(truth.gt_lines == 0).all(0, keepdim=True), truth.gt_lines > 0])
    noise = torch.Generator().manual_seed(0)
    numbers = truth.gt_lines.amax(0)[None].float()
    maps = LineMaps(
        8 * classes.float(),
        numbers.expand(4, -1, -1) + 1e-3 * torch.randn(4, 40, 80, generator=noise),
        8 * torch.nn.functional.one_hot(truth.gt_directions.long(), 37).sum(0).movedim(-1, 0),
    )
    settings = {"min_area_px": 20, "min_neighbours": 10, "step_px": 4}
    built = head(grid, vectorizing=settings)
    maps = maps._replace(direction=maps.direction.float(), embedding=torch.ones_like(maps[1]))
    found = built.lines(maps)
    assert sorted(found.labels_3d.tolist()) == [0, 1]
    for own in elements_of_predictions(found).polylines:
        ahead, left = (own[:, 1], -own[:, 0]) if grid is LIDAR else (own[:, 0], own[:, 1])
        assert np.ptp(ahead) > 18
        assert np.abs(np.abs(left) - 3).max() < 0.5
    labelled = dict(zip(found.labels_3d.tolist(), found.pts, strict=True))
    across = labelled[0][:, 0] if grid is LIDAR else -labelled[0][:, 1]
    assert (across < 0).all()  # the divider lies to the left


def test_nothing_found_is_an_empty_prediction():
    built = head().eval()
    built.decoder.maps[0][-1].bias.data[0] = 100.0
    (found,) = built.predict({"bev_feats": torch.randn(1, 8, 40, 20)}, [sample([])])
    assert found.pts.shape == (0, 2, 2)
    assert len(elements_of_predictions(found)) == 0


def cameras(number: int = 2) -> torch.Tensor:
    """Cameras 1.5 m above the ground that look ahead (+y of the LiDAR's frame)."""
    one = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1.0, 1.5], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
    return one.expand(1, number, 4, 4).clone()


def encoder(**settings) -> ViewTransformEncoder:
    torch.manual_seed(0)
    own = {"image_size": (32, 64), "bev_pixel_m": 0.6, "num_cams": 2}
    return ViewTransformEncoder(LIDAR, **{**own, **settings})


def test_the_cameras_see_ahead_and_a_sample_does_not_depend_on_its_batch():
    built = encoder()
    assert built.view_size == (8, 16)
    feats = torch.randn(2, 2, 3, 2, 4)
    matrices = torch.cat([cameras(), cameras() + 0.0])
    matrices[1, 0, :2, 3] += 0.4
    both = built.encode(feats, {"cam_from_ground": matrices}, (32, 64))["bev_feats"]
    assert both.shape == (2, 3, 40, 20)
    assert not both[:, :, :16].any()  # 2 m behind and farther
    assert both[:, :, 20:40, 6:14].abs().sum() > 0
    for i in range(2):
        own = {"cam_from_ground": matrices[i : i + 1]}
        torch.testing.assert_close(
            built.encode(feats[i : i + 1], own, (32, 64))["bev_feats"], both[i : i + 1]
        )


def test_places_of_cameras_in_metres_or_in_cells():
    moved = cameras()
    moved[..., 2, 3] = 3.0  # 3 m behind the origin
    released, right = (encoder(released_units=flag).cell_positions(moved) for flag in (True, False))
    torch.testing.assert_close(right[..., 0] - released[..., 0], torch.full((1, 2, 40, 20), 0.0))
    halves = [
        encoder(released_units=f, bev_pixel_m=0.3).cell_positions(moved) for f in (True, False)
    ]
    torch.testing.assert_close(halves[1] - halves[0], torch.tensor([3.0, 0.0]).expand_as(halves[0]))


def test_the_border_of_a_map_counts_as_outside():
    values = torch.arange(6.0).view(1, 1, 2, 3)
    places = torch.tensor([[[[0.0, 0.0], [1.5, 0.5], [2.0, 0.5], [-0.1, 0.0], [1.0, 1.0]]]])
    assert sample_maps(values, places).flatten().tolist() == [0.0, 3.0, 0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: head(num_directions=7), "num_directions must divide 360"),
        (
            lambda: head(num_directions=72, vectorizing={"degrees": 10}),
            "degrees is 10, but 72 directions are 5 degrees apart",
        ),
        (lambda: head(losses={"push": -1.0}), "losses.push must not be negative"),
        (lambda: encoder(image_size=(8, 8)), "neither may be empty"),
        (lambda: MakeLineMaps(step_m=0), "step_m must be more than 0"),
        (lambda: MakeLineMaps(num_directions=7), "num_directions must divide 360"),
        (lambda: sample([MapInstance(2, LINES[0].points)]), "label 2 of an element"),
        (lambda: encoder().transform_views(torch.zeros(1, 3, 1, 2, 4)), "built for 2 cameras"),
        (lambda: head().target(Det3DDataSample(), "gt_lines"), "put MakeLineMaps into"),
        (lambda: head(pixel_m=0.6).target(sample([]), "gt_lines"), "the head's maps are"),
        (
            lambda: head().target(sample(LINES, num_directions=72), "gt_directions"),
            "direction 37 of 36",
        ),
    ],
)
def test_what_does_not_fit_is_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_an_onnx_file_is_refused_with_its_reason():
    class Model:
        lidar_encoder, map_head = None, head()

    with pytest.raises(ValueError, match="HDMapNetHead cannot be exported: its lines are"):
        ExportedDetector(Model())
