# HDMapNet on nuScenes, EfficientNet-B0, cameras, 30 epochs, 4 samples per step, as published.
_base_ = [
    '../_base_/datasets/nuscenes_ego.py', './_base_/model.py',
    './_base_/schedule.py', '../_base_/default_runtime.py',
]

classes = ['divider', 'ped_crossing', 'boundary']
model = dict(grid=_base_.grid, classes=classes)
_cameras = [  # each has a network of its own
    'CAM_FRONT_LEFT', 'CAM_FRONT', 'CAM_FRONT_RIGHT', 'CAM_BACK_LEFT', 'CAM_BACK', 'CAM_BACK_RIGHT']
_scale = dict(type='ScaleImages', size=(352, 128))
_train = [_base_._load, _scale, dict(type='MakeLineMaps'), _base_._pack]
_dataset = dict(classes=classes, cameras=_cameras)
train_dataloader = dict(
    sampler=dict(_delete_=True, type='DefaultSampler', shuffle=True), dataset=dict(**_dataset, pipeline=_train))
val_dataloader = dict(
    sampler=dict(_delete_=True, type='DefaultSampler', shuffle=False),
    dataset=dict(**_dataset, pipeline=[_base_._load, _scale, _base_._pack]))
test_dataloader = val_dataloader
