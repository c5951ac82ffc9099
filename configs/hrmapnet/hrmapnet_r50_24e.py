# HRMapNet on MapTRv2, nuScenes, as published: ResNet-50, 24 epochs, 4 x 8 samples per step.
_base_ = [
    '../_base_/datasets/nuscenes.py', '../_base_/models/maptr_r50.py', '../maptrv2/_base_/model.py',
    './_base_/model.py', '../_base_/schedules/cosine.py', '../_base_/default_runtime.py',
]
_base_.model.merge(_base_._maptrv2)
_base_.model.merge(_base_._hrmapnet)

model = dict(grid=_base_.grid, classes=_base_.classes)
train_dataloader = dict(dataset=dict(pipeline=_base_._depth_seg))
train_cfg = dict(val_interval=4)
