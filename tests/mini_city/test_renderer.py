import numpy as np
import pytest
from shapely.geometry import box

from minicity.camera import Camera, clip_near
from minicity.lighting import Lighting
from minicity.meshes import Mesh, add_building
from minicity.renderer import SceneRenderer, render_camera
from minicity.rig import CAMERAS, mounted_camera, world_from_ego
from minicity.scene_map import HeightGrid, Marking, SceneMap, Surface, solid_line
from minicity.town import Building
from minicity.vehicles import Vehicle

DAY = Lighting(
    weather="clear",
    sun=np.array([0.0, 0.6, 0.8]),
    ambient=0.7,
    direct=0.4,
    shadow=0.0,
    gain=(1.0, 1.0, 1.0),
    sky_top=(200.0, 150.0, 90.0),
    haze=(220.0, 205.0, 185.0),
    haze_m=1e6,
    wet=0.0,
    noise=0.0,
    streaks=0,
)
BOUNDS = (-20.0, -40.0, 80.0, 40.0)
RED = Vehicle("vehicle.car", np.array([12.0, 0.0, 0.75]), 0.0, (4.5, 1.9, 1.5), (0.0, 0.0, 200.0))


def front_camera(width: int = 400, height: int = 225, y: float = 0.0) -> Camera:
    return mounted_camera(CAMERAS[0], width, height, world_from_ego(0.0, y, 0.0))


def renderer(
    markings: list[Marking], height: HeightGrid | None = None, static: Mesh | None = None
) -> SceneRenderer:
    scene = SceneMap([Surface(box(-20, -30, 80, 30), "asphalt")], [], markings, height)
    mesh = static.freeze() if static else None
    return SceneRenderer(scene, BOUNDS, DAY, 0.06, np.random.default_rng(0), mesh)


def shoot(
    scene: SceneRenderer, camera: Camera, vehicles: list[Vehicle] | None = None
) -> np.ndarray:
    return scene.render_camera(camera, vehicles or [], np.random.default_rng(1)).astype(int)


def project(camera: Camera, point: tuple[float, float, float]) -> np.ndarray:
    return camera.to_pixels(camera.to_camera(np.array(point)))


def line_column(image: np.ndarray, row: int, near: float) -> float:
    """Column of the centre of mass of what is brighter than asphalt, near a column."""
    low = max(0, round(near) - 20)
    brightness = image[row, low : round(near) + 21].mean(-1)
    weight = np.clip(brightness - 130, 0, None)
    assert weight.sum() > 0
    return low + float((weight * np.arange(len(weight))).sum() / weight.sum())


@pytest.mark.parametrize("offset_m", [-2.0, 0.0, 2.0])
@pytest.mark.parametrize("distance_m", [7.0, 12.0, 25.0])
def test_a_painted_line_lies_where_its_world_points_project(
    offset_m: float, distance_m: float
) -> None:
    line = np.array([[-10.0, offset_m], [70.0, offset_m]])
    camera = front_camera()
    image = shoot(renderer([Marking(solid_line(line, 0.2), "white", 0.0)]), camera)
    u, v = project(camera, (distance_m, offset_m, 0.0))
    row = round(v)
    # the line's column at the centre of the pixel row that is read
    ray = camera.world_from_pixel @ [u, row, 1.0]
    x = camera.center[0] - camera.center[2] / ray[2] * ray[0]
    expected = project(camera, (x, offset_m, 0.0))[0]
    # OpenCV rounds painted edges to half a pixel of the finer raster: 1.5 cm on the ground.
    tolerance = 0.25 + 0.015 * camera.intrinsics[0, 0] / (x - camera.center[0])
    assert line_column(image, row, expected) == pytest.approx(expected, abs=tolerance)


def test_thin_paint_keeps_its_contrast_far_away() -> None:
    line = np.array([[-10.0, 0.0], [75.0, 0.0]])
    camera = front_camera(800, 450, y=1.0)
    image = shoot(renderer([Marking(solid_line(line, 0.15), "white", 0.0)]), camera)
    u, v = np.round(project(camera, (30.0, 0.0, 0.0))).astype(int)
    paint = image[v, u - 2 : u + 3].mean(-1).max()
    asphalt = np.median(image[v, u + 15 : u + 40].mean(-1))
    # The line is 3 pixels wide at 30 m; a plain mip-map leaves less than 15 grey levels here.
    assert paint - asphalt > 60


def test_nothing_but_sky_above_the_horizon_and_no_sky_below() -> None:
    camera = front_camera()
    image = shoot(renderer([]), camera)
    horizon = project(camera, (1e6, 0.0, 0.0))[1]
    np.testing.assert_allclose(image[: int(horizon) - 1, :, 0].min(), 200, atol=25)
    assert image[int(horizon) + 3 :, :, 0].max() < 150


def test_a_level_height_grid_gives_the_picture_of_the_plane() -> None:
    markings = [Marking(solid_line(np.array([[-10.0, 2.0], [70.0, -5.0]]), 0.2), "white", 0.0)]
    grid = HeightGrid(np.array([-60.0, -60.0]), 1.0, np.zeros((140, 160)))
    pictures = [shoot(renderer(markings, h), front_camera()) for h in (None, grid)]
    difference = np.abs(pictures[0] - pictures[1]).max(-1)
    # The skyline itself may move by a row: the plane reaches further than the grid's last ring.
    horizon = round(project(front_camera(), (1e6, 0.0, 0.0))[1])
    assert (difference[horizon + 4 :] > 12).mean() < 0.01


@pytest.mark.parametrize("slope", [0.05, 0.12, -0.05])
def test_a_line_on_a_slope_lies_where_its_world_points_project(slope: float) -> None:
    x = np.arange(-60.0, 120.0)
    grid = HeightGrid(np.array([-60.0, -60.0]), 1.0, np.tile(slope * x, (140, 1)))
    marking = Marking(solid_line(np.array([[15.0, -20.0], [15.0, 20.0]]), 0.5), "white", 0.0)
    camera = front_camera()
    image = shoot(renderer([marking], grid), camera).mean(-1)
    for y in (-6.0, 0.0, 6.0):
        u, v = project(camera, (15.0, y, 15.0 * slope))
        column = image[:, round(u)]
        window = slice(round(v) - 8, round(v) + 9)
        assert window.start + int(np.argmax(column[window])) == pytest.approx(v, abs=1.5)


def test_a_crest_hides_what_lies_behind_it() -> None:
    x = np.arange(-60.0, 120.0)
    crest = HeightGrid(
        np.array([-60.0, -60.0]), 1.0, np.tile(4.0 * np.exp(-(((x - 20) / 5) ** 2)), (140, 1))
    )
    behind = Marking([np.array([[38.0, -20.0], [44.0, -20.0], [44.0, 20.0], [38.0, 20.0]])])
    camera = front_camera()
    hidden = shoot(renderer([behind], crest), camera)
    bare = shoot(renderer([], crest), camera)
    seen = shoot(renderer([behind]), camera)
    # A ray that grazes the crest itself may be off by a texel.
    assert (np.abs(hidden - bare).max(-1) > 3).mean() < 1e-3
    assert (np.abs(seen - shoot(renderer([]), camera)).max(-1) > 60).sum() > 500


def test_the_nearer_vehicle_hides_the_farther_one_whatever_their_order() -> None:
    green = Vehicle(
        RED.category, RED.center + np.array([8.0, 0.0, 0.0]), 0.0, RED.size, (0.0, 200.0, 0.0)
    )
    camera = front_camera()
    u, v = np.round(project(camera, (9.7, 0.0, 0.5))).astype(int)
    for order in ([RED, green], [green, RED]):
        _, greenish, red = shoot(renderer([]), camera, order)[v, u]
        assert red > 2 * greenish


def test_a_building_hides_the_vehicle_behind_it() -> None:
    mesh = Mesh()
    footprint = np.array([[8.0, -6.0], [10.0, -6.0], [10.0, 6.0], [8.0, 6.0]])
    add_building(mesh, Building(footprint, 6.0, (150.0, 160.0, 170.0)))
    camera = front_camera()
    scene = renderer([], static=mesh)
    shaded = shoot(scene, camera, [RED])
    clear = shoot(scene, camera)
    u, v = np.round(project(camera, tuple(RED.center))).astype(int)
    np.testing.assert_array_equal(shaded[v - 5 : v, u - 5 : u + 5], clear[v - 5 : v, u - 5 : u + 5])


def test_a_vehicle_beside_the_camera_is_cut_at_the_near_plane() -> None:
    beside = Vehicle(RED.category, np.array([1.5, -2.6, 0.75]), 0.0, RED.size, RED.color)
    camera = mounted_camera(CAMERAS[1], 400, 225, world_from_ego(0.0, 0.0, 0.0))
    image = shoot(renderer([]), camera, [beside])
    plain = shoot(renderer([]), camera)
    assert (np.abs(image - plain).max(-1) > 30).mean() > 0.1


def test_clip_near_worked_by_hand() -> None:
    square = np.array([[0.0, 0.0, -1.0], [2.0, 0.0, -1.0], [2.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    clipped = clip_near(square, 0.5)
    np.testing.assert_allclose(sorted(clipped[:, 2]), [0.5, 0.5, 1.0, 1.0])
    np.testing.assert_allclose(sorted(clipped[:, 0]), [0, 0, 2, 2])
    assert len(clip_near(square - np.array([0.0, 0.0, 5.0]), 0.5)) == 0


def test_one_call_renders_one_picture() -> None:
    scene = SceneMap([Surface(box(-20, -30, 80, 30), "asphalt")])
    image = render_camera(scene, front_camera(), DAY, [RED])
    assert image.shape == (225, 400, 3)
    assert image.dtype == np.uint8


def test_bad_input_is_named() -> None:
    scene = SceneMap()
    with pytest.raises(ValueError, match="bounds must be"):
        SceneRenderer(scene, (0, 0, -1, 1), DAY, 0.1, np.random.default_rng(0))
    with pytest.raises(ValueError, match="resolution_m must be positive"):
        SceneRenderer(scene, BOUNDS, DAY, 0.0, np.random.default_rng(0))
    with pytest.raises(ValueError, match="2 non-finite cells"):
        HeightGrid(np.zeros(2), 1.0, np.array([[0.0, np.nan], [np.inf, 0.0]]))
    with pytest.raises(ValueError, match=r"intrinsics must be \(3, 3\)"):
        Camera(np.eye(4), 10, 10, np.eye(4))
    with pytest.raises(ValueError, match="must be finite"):
        Camera(np.full((3, 3), np.nan), 10, 10, np.eye(4))
