# VectorMapNet on nuScenes, ResNet-50, 130 epochs, 8 x 5 samples per step, in the frame of the vehicle, as published.
_base_ = [
    '../_base_/datasets/nuscenes_ego.py', './_base_/model.py',
    './_base_/schedule.py', '../_base_/default_runtime.py',
]

model = dict(grid=_base_.grid, classes=_base_.classes)
_scale = dict(type='ScaleImages', size=(455, 256))
_images = [_base_._load, _scale, dict(type='StretchToPadding')]
_targets = dict(type='FormatPolylineTargets', edge_classes=(2,))
train_dataloader = dict(
    batch_size=5,
    sampler=dict(_delete_=True, type='DefaultSampler', shuffle=True),
    dataset=dict(pipeline=[*_images, _targets, _base_._pack]))
val_dataloader = dict(
    sampler=dict(type='DefaultSampler', shuffle=False), dataset=dict(pipeline=[*_images, _base_._pack]))
test_dataloader = val_dataloader
