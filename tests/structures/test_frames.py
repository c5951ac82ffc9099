import numpy as np

from gsmap.structures.frames import FRAME_VIEWS, FrameView
from mapdata.infos.plain_pickle import load_plain_pickle


def test_ahead_is_up_in_both_frames():
    ahead_and_right = {"lidar": [2.0, 10.0], "ego": [10.0, -2.0]}
    for frame, point in ahead_and_right.items():
        np.testing.assert_allclose(
            FRAME_VIEWS[frame].display_from_frame(np.array([point])), [[2, 10]]
        )


def test_display_turn_agrees_with_the_points():
    for view in FRAME_VIEWS.values():
        turn = view.display_turn_rad
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        points = np.array([[1.0, 2.0], [-3.0, 0.5]])
        np.testing.assert_allclose(view.display_from_frame(points), points @ rotation.T, atol=1e-12)


def test_lifted_uses_own_height_or_the_plane():
    view = FrameView("y", (0.1, -0.2, -1.5), (-1, 1, 1))
    np.testing.assert_allclose(view.lift(np.array([[1.0, 2, 7]])), [[1, 2, 7]])
    np.testing.assert_allclose(view.lift(np.array([[1.0, 2]])), [[1, 2, 0.1 - 0.4 - 1.5]])


def test_tilted_plane_is_the_vehicles_ground():
    angle = np.radians(1.4)
    ego_from_lidar = np.eye(4)
    ego_from_lidar[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    ego_from_lidar[:3, 3] = [0.9, 0.0, 1.84]
    view = FRAME_VIEWS["lidar"].with_mounting(ego_from_lidar)
    ground = view.lift(np.array([[0.0, 0], [5, 20], [-5, -20]]))
    in_vehicle = ground @ ego_from_lidar[:3, :3].T + ego_from_lidar[:3, 3]
    np.testing.assert_allclose(in_vehicle[:, 2], 0, atol=1e-12)


def test_identity_mounting_leaves_the_ground_level():
    assert FRAME_VIEWS["ego"].with_mounting(np.eye(4)).ground == (0, 0, -0.31)


def test_ground_of_a_real_sweep(shared_dir):
    folder = shared_dir / "nuscenes_sample"
    lidar = load_plain_pickle(next(folder.glob("*.pkl")))["data_list"][0]["lidar_points"]
    points = np.fromfile(folder / lidar["lidar_path"], np.float32).reshape(-1, 5)[:, :3]
    distance = np.hypot(points[:, 0], points[:, 1])
    road = points[(distance > 3) & (distance < 25) & (np.abs(points[:, 0]) < 8)]
    view = FRAME_VIEWS["lidar"].with_mounting(np.array(lidar["lidar2ego"]))
    plane = np.array(view.ground)
    inputs = np.column_stack([road[:, :2], np.ones(len(road))])
    for width in np.geomspace(0.5, 0.05, 12):  # fit, each time with fewer points off the road
        near = np.abs(road[:, 2] - inputs @ plane) < width
        plane = np.linalg.lstsq(inputs[near], road[near, 2], rcond=None)[0]
    assert near.sum() > 5000
    assert abs(plane[2] - view.ground[2]) < 0.01
    assert np.degrees(np.linalg.norm(plane[:2] - view.ground[:2])) < 0.3
    level = FRAME_VIEWS["lidar"]
    assert np.degrees(np.linalg.norm(plane[:2] - level.ground[:2])) > 1.0  # why the tilt matters
