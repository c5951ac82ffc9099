# nuScenes, six cameras at half size, ground truth of 60 x 30 m in the LIDAR_TOP frame. The other data sets say what
# differs. `python tools/create_data.py nuscenes --root data/nuscenes` makes the annotation files.
data_root = 'data/nuscenes/'
_file_size = (1600, 900)  # of the image files, width and height
# the one place of range and classes: leaves hand them to the model
grid = dict(x_range=[-15.0, 15.0], y_range=[-30.0, 30.0])  # metres; travel is along the longer side
classes = ['divider', 'ped_crossing', 'boundary']

_photometric = dict(
    type='MultiViewWrapper',
    transforms=[dict(type='PhotoMetricDistortion3D')],
    override_aug_config=False,  # each camera its own, as in MapTR
    collected_keys=[])
_load = dict(type='LoadCameraImages')
_scale = dict(type='ScaleImages', scale=0.5)
_dataset = dict(
    type='VectorizedMapDataset',
    data_root=data_root,
    classes=classes,
    grid=grid,
    frame='lidar',
    cameras=[
        'CAM_FRONT', 'CAM_FRONT_RIGHT', 'CAM_FRONT_LEFT', 'CAM_BACK', 'CAM_BACK_LEFT', 'CAM_BACK_RIGHT'
    ])

train_dataloader = dict(
    batch_size=4,
    num_workers=4,
    persistent_workers=True,
    sampler=dict(type='DefaultSampler', shuffle=True),
    dataset=dict(
        **_dataset,
        ann_file='gsmap_nuscenes_train.arrow',
        split='train',
        pipeline=[
            _load,
            _photometric,
            _scale,
            dict(type='FormatMapTargets', num_points=20),
            dict(type='PackMapInputs'),
        ]))
val_dataloader = dict(
    batch_size=1,
    num_workers=4,
    persistent_workers=True,
    sampler=dict(type='DefaultSampler', shuffle=False),
    dataset=dict(
        **_dataset,
        ann_file='gsmap_nuscenes_val.arrow',
        split='val',
        test_mode=True,
        pipeline=[_load, _scale, dict(type='PackMapInputs')]))
test_dataloader = val_dataloader
