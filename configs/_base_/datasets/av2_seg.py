# Argoverse 2 with what MapTRv2 trains on there besides map elements: BEV and camera masks (no LiDAR depth).
_base_ = './av2.py'

train_dataloader = dict(
    dataset=dict(pipeline=[
        dict(type='LoadCameraImages'),
        dict(type='ScaleImages', scale=0.3),
        _base_._photometric,
        dict(type='FormatMapTargets', num_points=20),
        dict(type='MakeBEVMask', size=(100, 200), num_classes=3),
        dict(type='MakePVMask', stride=32, ground_z_m=-0.3, num_classes=3),  # the origin is the rear axle
        dict(type='PackMapInputs'),
    ]))
