# MGMapNet on nuScenes, ResNet-50, 24 epochs, 8 x 2 samples per step.
_base_ = [
    '../_base_/datasets/nuscenes.py', '../_base_/models/maptr_r50.py', '../maptrv2/_base_/model.py',
    './_base_/model.py',
    '../_base_/schedules/cosine.py', '../_base_/default_runtime.py',
]
_base_.model.merge(_base_._maptrv2)
_base_.model.merge(_base_._mgmapnet)

model = dict(grid=_base_.grid, classes=_base_.classes)
train_dataloader = dict(batch_size=2, dataset=dict(pipeline=_base_._depth_seg))
optim_wrapper = dict(optimizer=dict(lr=4e-4))
auto_scale_lr = dict(base_batch_size=16)
