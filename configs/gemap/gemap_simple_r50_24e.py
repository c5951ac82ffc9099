# GeMap with its simple objective on nuScenes, ResNet-50, 24 epochs, 4 x 8 samples per step.
_base_ = [
    '../_base_/datasets/nuscenes.py', '../_base_/models/maptr_r50.py', './_base_/model.py',
    '../_base_/schedules/cosine.py', '../_base_/default_runtime.py',
]
_base_.model.merge(_base_._gemap)

model = dict(grid=_base_.grid, classes=_base_.classes)
optim_wrapper = dict(optimizer=dict(weight_decay=0.03))
train_cfg = dict(val_interval=1)
