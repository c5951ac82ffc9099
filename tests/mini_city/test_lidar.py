import numpy as np
from shapely.geometry import box

from minicity.lidar import footprint_array, scan, vehicle_footprints
from minicity.rig import LIDAR_POSITION, ego_from_lidar, world_from_ego
from minicity.scene_map import Marking, SceneMap, Surface
from minicity.texture import GroundTexture, paint_ground
from minicity.vehicles import Vehicle

CAR = Vehicle("vehicle.car", np.array([10.0, 0.0, 0.75]), 0.0, (4.0, 2.0, 1.5), (0.0, 0.0, 200.0))
STRIPE = np.array([[-40.0, 5.0], [40.0, 5.0], [40.0, 8.0], [-40.0, 8.0]])


def ground() -> GroundTexture:
    scene = SceneMap([Surface(box(-60, -60, 60, 60), "asphalt")], [], [Marking([STRIPE], wear=0.0)])
    return paint_ground(scene, (-50, -50, 50, 50), 0.1, np.random.default_rng(0))


def sweep(boxes: np.ndarray) -> np.ndarray:
    return scan(ego_from_lidar(), ground(), boxes, np.random.default_rng(1))


def test_ground_lies_the_sensors_height_below_it() -> None:
    cloud = sweep(np.zeros((0, 9)))
    np.testing.assert_allclose(cloud[:, 2], -LIDAR_POSITION[2], atol=0.05)
    assert set(cloud[:, 4]) <= set(range(32))


def test_points_on_a_car_lie_on_its_surface_and_shade_the_ground_behind() -> None:
    cloud = sweep(vehicle_footprints([CAR]))
    # sensor frame: x right, y forward; the car's back is at x = 8 m in the ego frame
    x, y, z = cloud[:, 0], cloud[:, 1] + LIDAR_POSITION[0], cloud[:, 2] + LIDAR_POSITION[2]
    on_car = z > 0.2
    assert on_car.sum() > 100
    np.testing.assert_allclose(y[on_car], 8.0, atol=0.08)
    assert np.abs(x[on_car]).max() <= 1.05
    behind = (np.abs(x) < 0.5) & (y > 8.1) & (y < 12.0)
    assert behind.sum() == 0


def test_the_nearest_of_two_walls_is_hit() -> None:
    near = np.array([[10.0, -20.0], [11.0, -20.0], [11.0, 20.0], [10.0, 20.0]])
    walls = footprint_array([near + np.array([5.0, 0.0]), near], [20.0, 20.0])
    cloud = sweep(walls)
    ahead = cloud[(np.abs(cloud[:, 0]) < 3) & (cloud[:, 1] > 0) & (cloud[:, 2] > -1.0)]
    np.testing.assert_allclose(ahead[:, 1] + LIDAR_POSITION[0], 10.0, atol=0.08)


def test_paint_returns_more_than_asphalt() -> None:
    cloud = sweep(np.zeros((0, 9)))
    left = -cloud[:, 0]
    paint = cloud[(left > 5.3) & (left < 7.7), 3]
    asphalt = cloud[(left > 9.0) & (left < 12.0), 3]
    assert np.median(paint) > 4 * np.median(asphalt)


def test_the_cloud_turns_with_the_car() -> None:
    pose = world_from_ego(0.0, 0.0, np.pi / 2) @ ego_from_lidar()
    cloud = scan(pose, ground(), vehicle_footprints([CAR]), np.random.default_rng(1))
    on_car = cloud[:, 2] + LIDAR_POSITION[2] > 0.2
    # The car stands east; the ego vehicle faces north, so it sees it on its right.
    assert cloud[on_car, 0].min() > 7.0
