# MiniCity with LiDAR: the points of the key frame beside the cameras.
_base_ = './minicity.py'

_points = [
    dict(type='LoadLidarPoints', coord_type='LIDAR', load_dim=5, use_dim=5),
    dict(type='PointsToFrame'),
]
train_dataloader = dict(
    dataset=dict(pipeline=[
        dict(type='LoadCameraImages', to_float32=False),
        *_points,
        dict(type='ScaleImages', scale=0.4),
        _base_._photometric,
        dict(type='FormatMapTargets', num_points=20),
        dict(type='PackMapInputs'),
    ]))
val_dataloader = dict(
    dataset=dict(pipeline=[
        dict(type='LoadCameraImages', to_float32=False),
        *_points,
        dict(type='ScaleImages', scale=0.4),
        dict(type='PackMapInputs'),
    ]))
test_dataloader = val_dataloader
