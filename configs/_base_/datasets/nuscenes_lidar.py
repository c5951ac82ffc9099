# nuScenes with LiDAR: ten sweeps beside the cameras.
_base_ = './nuscenes.py'

_points = [
    dict(type='LoadLidarPoints', coord_type='LIDAR', load_dim=5, use_dim=5),
    dict(
        type='LoadLidarSweeps',
        sweeps_num=9,
        use_dim=[0, 1, 2, 3, 4],
        pad_empty_sweeps=True,
        remove_close=True),
]
_test_points = [
    _points[0],
    dict(
        type='LoadLidarSweeps',
        sweeps_num=9,
        use_dim=[0, 1, 2, 3, 4],
        pad_empty_sweeps=True,
        remove_close=True,
        test_mode=True),
]
train_dataloader = dict(
    dataset=dict(pipeline=[
        dict(type='LoadCameraImages'),
        *_points,
        _base_._photometric,
        dict(type='ScaleImages', scale=0.5),
        dict(type='FormatMapTargets', num_points=20),
        dict(type='PackMapInputs'),
    ]))
val_dataloader = dict(
    dataset=dict(pipeline=[
        dict(type='LoadCameraImages'),
        *_test_points,
        dict(type='ScaleImages', scale=0.5),
        dict(type='PackMapInputs'),
    ]))
test_dataloader = val_dataloader
