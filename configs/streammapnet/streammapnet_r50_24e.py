# StreamMapNet on nuScenes, 60 x 30 m, ResNet-50, 24 epochs, 8 x 4 samples per step.
_base_ = [
    '../_base_/datasets/nuscenes_ego.py', '../_base_/models/maptr_r50.py', './_base_/model.py',
    '../_base_/schedules/cosine.py', '../_base_/default_runtime.py',
]
_base_.model.merge(_base_._streammapnet)
_base_.optim_wrapper.merge(_base_._optim_wrapper)

model = dict(grid=_base_.grid, classes=_base_.classes)
param_scheduler = _base_._param_scheduler
sync_bn = 'torch'  # of several ranks
train_cfg = dict(val_interval=4)
