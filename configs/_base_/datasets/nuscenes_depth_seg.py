# nuScenes with what MapTRv2 trains on besides map elements: LiDAR depth, BEV and camera masks.
_base_ = './nuscenes.py'

train_dataloader = dict(
    dataset=dict(pipeline=[
        dict(type='LoadCameraImages'),
        dict(type='LoadLidarPoints', coord_type='LIDAR', load_dim=5, use_dim=5),
        dict(
            type='MultiViewWrapper',
            transforms=[dict(type='PhotoMetricDistortion3D')],
            override_aug_config=False,  # each camera its own, as in MapTR
            collected_keys=[]),
        dict(type='ScaleImages', scale=0.5),
        dict(type='FormatMapTargets', num_points=20),
        dict(type='MakeDepthMap'),
        dict(type='MakeBEVMask', size=(200, 100)),
        dict(type='MakePVMask', stride=32),
        dict(type='PackMapInputs', with_points=False),
    ]))
