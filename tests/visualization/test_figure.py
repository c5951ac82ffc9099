"""What a picture shows, read back from its pixels."""

from itertools import combinations

import cv2
import numpy as np
import pytest
from matplotlib import colors as mcolors
from matplotlib.transforms import Bbox
from processes import run_python

from gsmap.structures.elements import MapElements
from gsmap.structures.frames import FRAME_VIEWS
from gsmap.structures.grid import BEVGrid
from gsmap.visualization import (
    BEVPanel,
    CameraView,
    MapStyle,
    compose_figure,
    figure_to_rgb,
    save_figure,
)
from gsmap.visualization.bev_view import raster_picture
from gsmap.visualization.camera_view import arrange_cameras, viewing_azimuth
from gsmap.visualization.style import CLASS_COLOURS, MATCH_COLOURS, RUN_COLOURS

STYLE = MapStyle()
GRID = BEVGrid((-15, 15), (-30, 30), 60, 30)
VIEW = FRAME_VIEWS["lidar"]


def camera(name, azimuth_deg, size=(160, 90), height_m=0.0):
    """A camera at the sensor that looks at an angle to the left of straight ahead, level."""
    angle = np.radians(azimuth_deg)
    ahead = np.array([-np.sin(angle), np.cos(angle), 0])  # LIDAR_TOP: x right, y forward
    right = np.array([np.cos(angle), np.sin(angle), 0])
    rotation = np.stack([right, [0, 0, -1], ahead])
    width, height = size
    intrinsics = np.array([[width * 0.8, 0, width / 2], [0, width * 0.8, height / 2], [0, 0, 1]])
    matrix = np.eye(4)
    matrix[:3, :3] = intrinsics @ rotation
    return CameraView(name, np.full((height, width, 3), 90, np.uint8), matrix)


RIG = [
    camera(name, azimuth)
    for name, azimuth in [
        ("CAM_FRONT", 0),
        ("CAM_FRONT_RIGHT", -55),
        ("CAM_FRONT_LEFT", 55),
        ("CAM_BACK", 180),
        ("CAM_BACK_LEFT", 110),
        ("CAM_BACK_RIGHT", -110),
    ]
]


def elements(**extra):
    ring = np.array([[-8.0, 5], [8, 5], [8, 9], [-8, 9], [-8, 5]])
    lines = (np.array([[0.0, 3], [0, 28]]), ring)
    return MapElements.from_polylines(lines, np.array([0, 1]), **extra)


def first_panel(figure):
    """The pixels of a figure's first panel."""
    picture, box = figure_to_rgb(figure), figure.axes[0].get_window_extent()
    bottom = picture.shape[0] - round(box.y0)
    return picture[bottom - round(box.height) : bottom, round(box.x0) : round(box.x1)]


def colour_share(picture, colour):
    """Share of the pixels that have almost exactly this colour."""
    wanted = np.round(np.array(mcolors.to_rgb(colour)) * 255)
    return (np.abs(picture.astype(int) - wanted).max(axis=-1) <= 3).mean()


def names(rows):
    return [[c.name.removeprefix("CAM_") for c in row] for row in rows]


def test_azimuth_is_positive_to_the_left():
    assert viewing_azimuth(camera("a", 55).img_from_frame, VIEW) == pytest.approx(np.radians(55))
    assert viewing_azimuth(camera("a", -110).img_from_frame, VIEW) == pytest.approx(
        np.radians(-110)
    )


def test_six_cameras_stand_as_on_the_car():
    assert names(arrange_cameras(RIG, VIEW)) == [
        ["FRONT_LEFT", "FRONT", "FRONT_RIGHT"],
        ["BACK_LEFT", "BACK", "BACK_RIGHT"],
    ]


def test_seven_cameras_stand_as_on_the_car():
    rig = [("fc", 0), ("fl", 45), ("fr", -45), ("sl", 99), ("sr", -99), ("rl", 153), ("rr", -153)]
    rows = arrange_cameras([camera(name, azimuth) for name, azimuth in rig], VIEW)
    assert names(rows) == [["fl", "fc", "fr"], ["sl", "rl", "rr", "sr"]]


def test_missing_cameras_leave_no_empty_row():
    assert names(arrange_cameras(RIG[:1], VIEW)) == [["FRONT"]]
    assert names(arrange_cameras(RIG[3:4], VIEW)) == [["BACK"]]


def test_line_ahead_appears_in_the_front_camera_only():
    line = MapElements.from_polylines((np.array([[0.0, 3], [0, 28]]),), np.array([0]))
    for view, expected in ((RIG[0], True), (RIG[3], False)):
        picture = figure_to_rgb(compose_figure([view], [], GRID, VIEW, STYLE, line))
        body = picture[80:]  # below the legend
        assert (colour_share(body, STYLE.colour(0)) > 1e-3) == expected


@pytest.mark.parametrize(("z", "row"), [(2.0, 19.4), (-2.0, 70.6), (None, 68.552)])
def test_cameras_project_the_height_of_points(z, row):
    """A line across, 10 m ahead: its row of 90 is 45 - 128 z / 10; the ground lies at -1.84 m."""
    ends = np.array([[-5.0, 10], [5, 10]])
    points = ends if z is None else np.c_[ends, [z, z]]
    line = MapElements.from_polylines((points,), np.array([0]))
    figure = compose_figure([RIG[0]], [], GRID, VIEW, STYLE, line)
    window = first_panel(figure)
    wanted = np.round(np.array(mcolors.to_rgb(STYLE.colour(0))) * 255)
    rows, _ = np.nonzero(np.abs(window.astype(int) - wanted).max(axis=-1) <= 3)
    assert rows.mean() / len(window) * 90 == pytest.approx(row, abs=0.5)


def test_names_with_dollar_signs_are_no_formulas():
    panel = BEVPanel("cost_$5^_vs_$6", elements(), note="a$ b$^")
    figure_to_rgb(compose_figure([], [panel], GRID, VIEW, STYLE, title="$_ $"))


def test_bird_s_eye_views_ignore_the_height_of_points():
    extra = {
        "scores": np.array([0.9, 0.5]),
        "scales": (np.full((2, 2), 0.5), np.full((5, 2), 0.5)),
        "rotations": (np.zeros(2), np.zeros(5)),
    }
    flat = elements(**extra)
    z = np.linspace(-3, 3, 2), np.linspace(2, 5, 5)
    lines = [np.c_[line, height] for line, height in zip(flat.polylines, z, strict=True)]
    high = MapElements.from_polylines(lines, flat.labels, **extra)
    for frame in ("lidar", "ego"):
        first, second = (
            figure_to_rgb(compose_figure([], panels, GRID, FRAME_VIEWS[frame], STYLE))
            for panels in (
                [BEVPanel("", e, vertices=True, order=True, gaussians=True, scores=True)]
                for e in (flat, high)
            )
        )
        np.testing.assert_array_equal(first, second)


def test_elements_appear_in_bev_where_they_are():
    panel = BEVPanel(
        "", MapElements.from_polylines((np.array([[-14.0, 29], [-1, 29]]),), np.array([2]))
    )
    figure = compose_figure([], [panel], GRID, VIEW, STYLE)
    window = first_panel(figure)
    half = window.shape[1] // 2
    top = window[: window.shape[0] // 10]
    assert colour_share(top[:, :half], STYLE.colour(2)) > 0.01
    assert colour_share(top[:, half:], STYLE.colour(2)) == 0
    assert colour_share(window[window.shape[0] // 10 :], STYLE.colour(2)) == 0


def test_every_kind_of_panel_is_drawn():
    scales, rotations = np.full((1, 5, 2), 0.5), np.zeros((1, 5))
    found = MapElements.from_polylines(
        (np.stack([np.zeros(5), np.linspace(0, 20, 5)], 1),),
        np.array([0]),
        np.array([0.9]),
        scales,
        rotations,
    )
    panels = [
        BEVPanel("none", None),
        BEVPanel("empty", MapElements.from_polylines((), np.empty(0, int))),
        BEVPanel("all", found, vertices=True, order=True, gaussians=True, scores=True),
        BEVPanel("raster", found, lines=False, rasters=np.ones((1, 60, 30))),
    ]
    for frame, grid in (("lidar", GRID), ("ego", BEVGrid((-30, 30), (-15, 15), 30, 60))):
        view = FRAME_VIEWS[frame]
        picture = figure_to_rgb(compose_figure(RIG, panels, grid, view, STYLE, found))
        assert picture.shape[1] == 1500
        assert colour_share(picture, STYLE.colour(0)) > 0.08  # the full raster


def test_a_small_map_without_ticks_and_a_line_of_one_point_are_drawn():
    grid = BEVGrid((1.0, 4.0), (1.0, 4.0), 10, 10)
    single = MapElements.from_polylines((np.array([[2.0, 2.0]]),), np.array([0]))
    panel = BEVPanel("", single, order=True)
    compose_figure([], [panel], grid, VIEW, STYLE)


def test_gaussian_ellipse_has_its_one_sigma_size():
    # 4 m along x and 2 m along y, turned by 90 degrees: at 1 sigma it is 4 m wide and 8 m high.
    single = MapElements.from_polylines(
        (np.array([[0.0, 15.0]]),),
        np.array([2]),
        scales=np.array([[[4.0, 2.0]]]),
        rotations=np.array([[np.pi / 2]]),
    )
    figure = compose_figure(
        [], [BEVPanel("", single, gaussians=True, lines=False)], GRID, VIEW, STYLE
    )
    picture = figure_to_rgb(figure).astype(int)
    box = figure.axes[0].get_window_extent()
    metre_px = box.width / 30
    green = np.abs(picture - np.round(np.array(mcolors.to_rgb(STYLE.colour(2))) * 255)).max(-1) < 60
    rows, columns = np.nonzero(green[80:])
    assert np.ptp(columns) / metre_px == pytest.approx(
        4.0, abs=0.35
    )  # the edge is about 0.2 m wide
    assert np.ptp(rows) / metre_px == pytest.approx(8.0, abs=0.35)


def test_raster_picture_blends_over_white():
    rasters = np.zeros((2, 1, 3))
    rasters[0, 0, 0], rasters[1, 0, 1] = 1.0, 0.5
    picture = raster_picture(rasters, np.array([0, 2]), STYLE)
    np.testing.assert_allclose(picture[0, 0], mcolors.to_rgb(STYLE.colour(0)))
    np.testing.assert_allclose(picture[0, 1], 0.5 + 0.5 * np.array(mcolors.to_rgb(STYLE.colour(2))))
    np.testing.assert_allclose(picture[0, 2], 1)


def test_raster_lies_where_its_lines_lie_in_both_frames():
    # Only the quarter ahead and to the right is covered.
    for frame, grid, rows, columns in (
        ("lidar", GRID, slice(30, 60), slice(15, 30)),
        ("ego", BEVGrid((-30, 30), (-15, 15), 30, 60), slice(0, 15), slice(30, 60)),
    ):
        raster = np.zeros((1, grid.height, grid.width))
        raster[0, rows, columns] = 1
        single = MapElements.from_polylines((np.zeros((2, 2)),), np.array([0]))
        panel = BEVPanel("", single, lines=False, rasters=raster)
        figure = compose_figure([], [panel], grid, FRAME_VIEWS[frame], STYLE)
        window = first_panel(figure)
        h, w = (n // 2 for n in window.shape[:2])
        assert colour_share(window[:h, w:], STYLE.colour(0)) > 0.9
        assert colour_share(window[:h, :w], STYLE.colour(0)) < 0.02
        assert colour_share(window[h:], STYLE.colour(0)) < 0.02


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp", ".pdf", ".svg"])
def test_pictures_are_written_whole(tmp_path, suffix):
    figure = compose_figure([], [BEVPanel("", elements())], GRID, VIEW, STYLE, width_px=600)
    path = save_figure(figure, tmp_path / "new" / f"picture{suffix}")
    assert path.stat().st_size > 1000
    assert list(path.parent.iterdir()) == [path]


def test_an_svg_stays_small(tmp_path):
    """Six photographs and twenty elements with Gaussians, as a busy crossing of nuScenes has."""
    rng = np.random.default_rng(0)
    noise = cv2.resize(rng.integers(0, 255, (27, 48, 3), np.uint8), (1600, 900))
    rig = [camera(c.name, a, (1600, 900)) for c, a in zip(RIG, range(0, 360, 60), strict=True)]
    rig = [CameraView(c.name, noise, c.img_from_frame) for c in rig]
    lines = [np.c_[np.full(20, x), np.linspace(-30, 30, 20)] for x in np.linspace(-14, 14, 20)]
    found = MapElements.from_polylines(
        lines,
        np.arange(20) % 3,
        np.linspace(0.4, 1, 20),
        np.full((20, 20, 2), 0.5),
        np.zeros((20, 20)),
    )
    panels = [
        BEVPanel("", found),
        BEVPanel("", found, vertices=True, scores=True),
        BEVPanel("", found, truth=found, hits=np.arange(20)),
        BEVPanel("", found, lines=False, gaussians=True),
    ]
    figure = compose_figure(rig, panels, GRID, VIEW, STYLE, found)
    text = save_figure(figure, tmp_path / "busy.svg").read_text()
    assert len(text) < 500_000
    assert text.count("data:image/jpeg") == 6
    assert "data:image/png" not in text
    assert 'transform="scale(0.015625)"' in text  # of glyphs, which a shorter number would shrink


def test_scores_are_clear_of_the_vehicle_the_border_and_each_other():
    xs = np.array([-0.6, -0.3, 0.0, 0.3, 14.9])
    lines = [np.c_[np.full(13, x), np.linspace(-6, 6, 13)] for x in xs]
    found = MapElements.from_polylines(lines, np.zeros(5, int), np.array([0.5, 0.6, 0.9, 0.8, 0.7]))
    figure = compose_figure([], [BEVPanel("", found, scores=True)], GRID, VIEW, STYLE)
    figure.canvas.draw()
    (ax,) = figure.axes
    boxes = {t.get_text(): t.get_window_extent() for t in ax.texts}
    assert set(boxes) == {"0.90", "0.80", "0.60", "0.50"}  # at the border there is no room
    rear, front, width = VIEW.vehicle_m
    car = ax.transData.transform_bbox(Bbox([[-width / 2, rear], [width / 2, front]]))
    shown = [*boxes.values(), car]
    assert not any(a.overlaps(b) for a, b in combinations(shown, 2))


def test_the_legend_has_what_is_drawn():
    def legend(*panels, over=None):
        figure = compose_figure(RIG[:1], panels, GRID, VIEW, STYLE, over, width_px=300)
        return [text.get_text() for text in figure.legends[0].get_texts()]

    boundary = MapElements.from_polylines((np.array([[-14.0, 29], [-1, 29]]),), np.array([2]))
    assert legend(BEVPanel("", elements())) == ["divider", "pedestrian crossing"]
    assert legend(BEVPanel("", None), over=boundary) == ["road boundary"]
    assert legend(BEVPanel("", MapElements.from_polylines())) == []


def test_a_colour_means_one_thing():
    assert not set(RUN_COLOURS) & {*CLASS_COLOURS.values(), *MATCH_COLOURS.values()}


def test_width_is_kept():
    figure = compose_figure(RIG, [], GRID, VIEW, STYLE, width_px=900)
    assert figure_to_rgb(figure).shape[1] == 900


def test_same_class_has_the_same_colour_in_every_order():
    other = MapStyle(classes=("boundary", "stop_line"))
    assert other.colour(0) == STYLE.colour(2)
    assert other.colour(1) not in {STYLE.colour(i) for i in range(3)}
    assert (STYLE.title(1), other.title(1)) == ("pedestrian crossing", "stop line")


def test_bad_arguments(tmp_path):
    with pytest.raises(ValueError, match="at least one camera or one panel"):
        compose_figure([], [], GRID, VIEW, STYLE)
    figure = compose_figure(RIG[:1], [], GRID, VIEW, STYLE)
    with pytest.raises(ValueError, match=r"must end in one of"):
        save_figure(figure, tmp_path / "picture.bmp")
    with pytest.raises(ValueError, match="camera X must be RGB uint8"):
        CameraView("X", np.zeros((4, 4, 3)), np.eye(4))
    with pytest.raises(ValueError, match="scores must have one entry for each of the 2"):
        elements(scores=np.ones(3))


def test_pictures_and_pages_need_neither_torch_nor_openmmlab():
    code = "import sys, gsmap.visualization, gsmap.visualization.page.page, drivemaps.video\n"
    run_python("-c", code + "assert not {'torch', 'mmengine'} & set(sys.modules)", check=True)
