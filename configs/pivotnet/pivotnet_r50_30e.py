# PivotNet on nuScenes, ResNet-50, 30 epochs, 8 x 1 samples per step, as published. The annotation files are made with
# `--crossings edges --tag _edges`.
_base_ = [
    '../_base_/datasets/nuscenes.py', './_base_/model.py',
    '../_base_/schedules/steps.py', '../_base_/default_runtime.py',
]

model = dict(grid=_base_.grid, classes=_base_.classes)
_cameras = [  # neighbours side by side
    'CAM_FRONT_LEFT', 'CAM_FRONT', 'CAM_FRONT_RIGHT', 'CAM_BACK_LEFT', 'CAM_BACK', 'CAM_BACK_RIGHT']
_data = dict(cameras=_cameras, crossings='edges')
_scale = dict(type='ScaleImages', size=(896, 512))
_steps = [_base_._load, _scale, dict(type='FormatPivotTargets'), _base_._pack]
train_dataloader = dict(
    batch_size=1,
    dataset=dict(**_data, ann_file='gsmap_nuscenes_train_edges.arrow', filter_empty_gt=False, pipeline=_steps))
val_dataloader = dict(
    dataset=dict(**_data, ann_file='gsmap_nuscenes_val_edges.arrow', pipeline=[_base_._load, _scale, _base_._pack]))
test_dataloader = val_dataloader
sync_bn = 'torch'
