# Argoverse 2, seven ring cameras at 0.3 of their size (padded to one size first), ground truth of
# 60 x 30 m in the ego frame. `python tools/create_data.py av2 --root data/av2 --split train --rate 2.5hz`, and
# the same for val, make the annotation files: every fourth sweep, as in MapTR's evaluation.
data_root = 'data/av2/'
# the one place of range and classes: leaves hand them to the model
grid = dict(x_range=[-30.0, 30.0], y_range=[-15.0, 15.0])  # metres; travel is along the longer side
classes = ['divider', 'ped_crossing', 'boundary']

_cameras = [
    'ring_front_center', 'ring_front_right', 'ring_front_left', 'ring_rear_right', 'ring_rear_left',
    'ring_side_right', 'ring_side_left'
]
_photometric = dict(
    type='MultiViewWrapper',
    transforms=[dict(type='PhotoMetricDistortion3D')],
    override_aug_config=False,  # each camera its own, as in MapTR
    collected_keys=[])
_train_pipeline = [
    dict(type='LoadCameraImages'),
    dict(type='ScaleImages', scale=0.3),
    _photometric,
    dict(type='FormatMapTargets', num_points=20),
    dict(type='PackMapInputs'),
]
_test_pipeline = [
    dict(type='LoadCameraImages'),
    dict(type='ScaleImages', scale=0.3),
    dict(type='PackMapInputs'),
]
_dataset = dict(
    type='VectorizedMapDataset',
    data_root=data_root,
    classes=classes,
    grid=grid,
    frame='ego',
    cameras=_cameras)

train_dataloader = dict(
    batch_size=6,
    num_workers=4,
    persistent_workers=True,
    sampler=dict(type='DefaultSampler', shuffle=True),
    dataset=dict(
        **_dataset,
        ann_file='gsmap_av2_train.arrow',
        split='train',
        pipeline=_train_pipeline))
val_dataloader = dict(
    batch_size=1,
    num_workers=4,
    persistent_workers=True,
    sampler=dict(type='DefaultSampler', shuffle=False),
    dataset=dict(
        **_dataset,
        ann_file='gsmap_av2_val.arrow',
        split='val',
        test_mode=True,
        pipeline=_test_pipeline))
test_dataloader = val_dataloader
