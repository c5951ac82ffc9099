# MiniCity: generated towns in nuScenes format, six cameras at 0.4 of their size.
# `python tools/create_data.py minicity --root data/minicity` makes the images,
# `python tools/create_data.py nuscenes --root data/minicity` the annotation files.
data_root = 'data/minicity/'
# the one place of range and classes: leaves hand them to the model
grid = dict(x_range=[-15.0, 15.0], y_range=[-30.0, 30.0])  # metres; travel is along the longer side
classes = ['divider', 'ped_crossing', 'boundary']

_cameras = [
    'CAM_FRONT', 'CAM_FRONT_RIGHT', 'CAM_FRONT_LEFT', 'CAM_BACK', 'CAM_BACK_LEFT', 'CAM_BACK_RIGHT'
]
_scale = 0.4
_photometric = dict(
    type='MultiViewWrapper',
    transforms=[dict(type='PhotoMetricDistortion3D')],
    override_aug_config=False,  # each camera its own, as in MapTR
    collected_keys=[])
_train_pipeline = [
    dict(type='LoadCameraImages', to_float32=False),
    dict(type='ScaleImages', scale=_scale),
    _photometric,
    dict(type='FormatMapTargets', num_points=20),
    dict(type='PackMapInputs'),
]
_test_pipeline = [
    dict(type='LoadCameraImages', to_float32=False),
    dict(type='ScaleImages', scale=_scale),
    dict(type='PackMapInputs'),
]
_dataset = dict(
    type='VectorizedMapDataset',
    data_root=data_root,
    classes=classes,
    grid=grid,
    frame='lidar',
    cameras=_cameras)

train_dataloader = dict(
    batch_size=4,
    num_workers=1,
    persistent_workers=True,
    sampler=dict(type='DefaultSampler', shuffle=True),
    dataset=dict(
        **_dataset,
        ann_file='gsmap_minicity_train.arrow',
        split='train',
        pipeline=_train_pipeline))
val_dataloader = dict(
    batch_size=1,
    num_workers=1,
    persistent_workers=True,
    sampler=dict(type='DefaultSampler', shuffle=False),
    dataset=dict(
        **_dataset,
        ann_file='gsmap_minicity_val.arrow',
        split='val',
        test_mode=True,
        pipeline=_test_pipeline))
test_dataloader = val_dataloader
