# MapQR on Argoverse 2 as published, 6 epochs, 4 x 8 samples per step.
_base_ = [
    '../_base_/datasets/av2.py', '../_base_/models/maptr_r50.py', './_base_/model.py',
    '../_base_/schedules/cosine.py', '../_base_/default_runtime.py',
]
_base_.model.merge(_base_._mapqr)

model = dict(grid=_base_.grid, classes=_base_.classes, bev_encoder=dict(num_cams=7, z_range=(-5.0, 3.0)))
train_dataloader = dict(batch_size=4, dataset=dict(pipeline=_base_._seg))
_base_.param_scheduler[0].end = 200
param_scheduler = _base_.param_scheduler
train_cfg = dict(max_epochs=6, val_interval=1)
