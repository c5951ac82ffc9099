# Argoverse 2 as in av2_seg.py, with depth from the LiDAR sweep that each sample names (docs/argoverse2.md).
_base_ = './av2.py'

train_dataloader = dict(
    dataset=dict(pipeline=[
        dict(type='LoadCameraImages'),
        dict(type='LoadLidarPoints', coord_type='LIDAR', load_dim=5, use_dim=5),
        dict(type='PointsToFrame'),
        dict(type='ScaleImages', scale=0.3),
        _base_._photometric,
        dict(type='FormatMapTargets', num_points=20),
        dict(type='MakeDepthMap'),
        dict(type='MakeBEVMask', size=(100, 200), num_classes=3),
        dict(type='MakePVMask', stride=32, ground_z_m=-0.3, num_classes=3),  # the origin is the rear axle
        dict(type='PackMapInputs', with_points=False),
    ]))
