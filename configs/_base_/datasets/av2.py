# Argoverse 2, seven ring cameras at 0.3 of their size (padded to one size first), ground truth of
# 60 x 30 m in the ego frame. `python tools/create_data.py av2 --root data/av2 --split train`, and the same for val,
# make the annotation files: every sweep (10 Hz) for training, every fourth for validation, as in the published systems;
# with `--dim 3`, masks of the cameras lie at true heights. Vehicle signals are made of the pose, as there.
data_root = 'data/av2/'
_file_size = (2048, 2048)  # of the image files, width and height, with the padding
# the one place of range and classes: leaves hand them to the model
grid = dict(x_range=[-30.0, 30.0], y_range=[-15.0, 15.0])  # metres; travel is along the longer side
classes = ['divider', 'ped_crossing', 'boundary']

_load = dict(type='LoadCameraImages')
_scale = dict(type='ScaleImages', scale=0.3)
_photometric = dict(type='DistortImages')  # each camera its own, as in MapTR
_targets = dict(type='FormatMapTargets')
_pack = dict(type='PackMapInputs')

_workers = dict(num_workers='cores', persistent_workers=True)
_dataset = dict(
    type='VectorizedMapDataset', data_root=data_root, classes=classes, grid=grid, frame='ego', pose_only_signals=True,
    cameras=[
        'ring_front_center', 'ring_front_right', 'ring_front_left', 'ring_rear_right', 'ring_rear_left',
        'ring_side_right', 'ring_side_left'
    ])
train_dataloader = dict(
    batch_size=6,
    **_workers,
    sampler=dict(type='DefaultSampler', shuffle=True),
    dataset=dict(
        **_dataset,
        ann_file='gsmap_av2_train.arrow',
        split='train',
        rate_hz=10.0,  # an epoch is as long as the papers' (a file of another rate is refused)
        pipeline=[_load, _scale, _photometric, _targets, _pack]))
val_dataloader = dict(
    batch_size=1,
    **_workers,
    sampler=dict(type='DefaultSampler', shuffle=False),
    dataset=dict(
        **_dataset, ann_file='gsmap_av2_val.arrow', split='val', test_mode=True, pipeline=[_load, _scale, _pack]))
test_dataloader = val_dataloader

# Pipelines for leaves to choose. Some methods learn from BEV and camera masks besides map elements, and from the depth
# of the LiDAR sweep that each sample names (docs/data.md).
_masks = [
    dict(type='MakeBEVMask', size=(100, 200), num_classes=3),
    dict(type='MakePVMask', stride=32, ground_z_m=-0.3, num_classes=3, heights=True),  # the origin is the rear axle
]
_seg = [_load, _scale, _photometric, _targets, *_masks, _pack]
_depth_seg = [
    _load,
    dict(type='LoadLidarPoints', coord_type='LIDAR', load_dim=5, use_dim=5),
    dict(type='PointsToFrame'),
    _scale, _photometric, _targets,
    dict(type='MakeDepthMap'),
    *_masks,
    dict(type='PackMapInputs', with_points=False),
]
