# GeMap with its simple objective on Argoverse 2, 24 epochs, 4 x 8 samples per step.
_base_ = [
    '../_base_/datasets/av2.py', '../_base_/models/maptr_r50.py', './_base_/model.py',
    '../_base_/schedules/cosine.py', '../_base_/default_runtime.py',
]
_base_.model.merge(_base_._gemap)

model = dict(
    grid=_base_.grid, classes=_base_.classes,
    img_backbone=dict(frozen_stages=-1),
    bev_encoder=dict(num_cams=7, z_range=(-5.0, 3.0)))
optim_wrapper = dict(optimizer=dict(weight_decay=0.03))
param_scheduler = [dict(_base_.param_scheduler[0], end=200), _base_.param_scheduler[1]]
train_dataloader = dict(batch_size=4)
train_cfg = dict(val_interval=1)
