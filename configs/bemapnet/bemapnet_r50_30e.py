# BeMapNet on nuScenes, ResNet-50, 30 epochs, 8 x 1 samples per step, as published but for random mirroring.
_base_ = [
    '../_base_/datasets/nuscenes.py', './_base_/model.py',
    '../_base_/schedules/steps.py', '../_base_/default_runtime.py',
]

model = dict(grid=_base_.grid, classes=_base_.classes)
_cameras = [
    'CAM_FRONT_LEFT', 'CAM_FRONT', 'CAM_FRONT_RIGHT', 'CAM_BACK_LEFT', 'CAM_BACK', 'CAM_BACK_RIGHT']
_images = [_base_._load, dict(type='ScaleImages', size=(896, 512)), dict(type='CropImages', top=128)]
_steps = [*_images, dict(type='FormatBezierTargets'), _base_._pack]
train_dataloader = dict(batch_size=1, dataset=dict(cameras=_cameras, pipeline=_steps))
val_dataloader = dict(dataset=dict(cameras=_cameras, pipeline=[*_images, _base_._pack]))
test_dataloader = val_dataloader
param_scheduler = [dict(type='MultiStepLR', by_epoch=True, milestones=[21, 27], gamma=1 / 3)]
sync_bn = 'torch'
