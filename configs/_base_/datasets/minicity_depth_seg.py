# MiniCity with what MapTRv2 trains on besides map elements: LiDAR depth, BEV and camera masks.
_base_ = './minicity.py'

train_dataloader = dict(
    dataset=dict(pipeline=[
        dict(type='LoadCameraImages', to_float32=False),
        dict(type='LoadLidarPoints', coord_type='LIDAR', load_dim=5, use_dim=5),
        dict(type='ScaleImages', scale=0.4),
        _base_._photometric,
        dict(type='FormatMapTargets', num_points=20),
        dict(type='MakeDepthMap'),
        dict(type='MakeBEVMask', size=(50, 25), thickness_px=1, num_classes=3),
        dict(type='MakePVMask', stride=16, num_classes=3),
        dict(type='PackMapInputs', with_points=False),
    ]))
