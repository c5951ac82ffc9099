# MiniCity: generated towns in nuScenes format, six cameras at 0.4 of their size.
# `python tools/create_data.py minicity --root data/minicity` makes the images,
# `python tools/create_data.py nuscenes --root data/minicity` the annotation files.
data_root = 'data/minicity/'
_file_size = (800, 450)  # of the image files, width and height
# the one place of range and classes: leaves hand them to the model
grid = dict(x_range=[-15.0, 15.0], y_range=[-30.0, 30.0])  # metres; travel is along the longer side
classes = ['divider', 'ped_crossing', 'boundary']

_load = dict(type='LoadCameraImages', to_float32=False)
_scale = dict(type='ScaleImages', scale=0.4)
_photometric = dict(type='DistortImages')  # each camera its own, as in MapTR
_targets = dict(type='FormatMapTargets')
_pack = dict(type='PackMapInputs')

_workers = dict(num_workers=1, persistent_workers=True)
_dataset = dict(
    type='VectorizedMapDataset', data_root=data_root, classes=classes, grid=grid, frame='lidar',
    cameras=[
        'CAM_FRONT', 'CAM_FRONT_RIGHT', 'CAM_FRONT_LEFT', 'CAM_BACK', 'CAM_BACK_LEFT', 'CAM_BACK_RIGHT'
    ])
train_dataloader = dict(
    batch_size=4,
    **_workers,
    sampler=dict(type='DefaultSampler', shuffle=True),
    dataset=dict(
        **_dataset,
        ann_file='gsmap_minicity_train.arrow',
        split='train',
        pipeline=[_load, _scale, _photometric, _targets, _pack]))
val_dataloader = dict(
    batch_size=1,
    **_workers,
    sampler=dict(type='DefaultSampler', shuffle=False),
    dataset=dict(
        **_dataset, ann_file='gsmap_minicity_val.arrow', split='val', test_mode=True, pipeline=[_load, _scale, _pack]))
test_dataloader = val_dataloader

# Pipelines for leaves to choose. Some methods learn from BEV and camera masks besides map elements, some from
# LiDAR depth too.
_points = dict(type='LoadLidarPoints', coord_type='LIDAR', load_dim=5, use_dim=5)
_to_frame = dict(type='PointsToFrame')  # changes nothing in the frame of the LiDAR
_masks = [
    dict(type='MakeBEVMask', size=(50, 25), thickness_px=1, num_classes=3),
    dict(type='MakePVMask', stride=8, num_classes=3),
]
_seg = [_load, _scale, _photometric, _targets, *_masks, _pack]
_depth_seg = [
    _load, _points, _to_frame, _scale, _photometric, _targets,
    dict(type='MakeDepthMap'),
    *_masks,
    dict(type='PackMapInputs', with_points=False),
]
# Models with LiDAR see the points of the key frame.
_lidar = [_load, _points, _to_frame, _scale, _photometric, _targets, _pack]
_lidar_test = [_load, _points, _to_frame, _scale, _pack]
