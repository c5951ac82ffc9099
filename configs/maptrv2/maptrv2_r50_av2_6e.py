# MapTRv2 on Argoverse 2, 6 epochs, 4 x 8 samples per step.
_base_ = [
    '../_base_/datasets/av2.py', '../_base_/models/maptr_r50.py', './_base_/model.py',
    '../_base_/schedules/cosine.py', '../_base_/default_runtime.py',
]
_base_.model.merge(_base_._maptrv2)

model = dict(
    grid=_base_.grid, classes=_base_.classes,
    bev_encoder=dict(z_range=(-5.0, 3.0)),
    map_head=dict(aux_heads=_base_._maptrv2.map_head.aux_heads[:2]))
train_dataloader = dict(batch_size=4, dataset=dict(pipeline=_base_._seg))
param_scheduler = [dict(_base_.param_scheduler[0], end=200), _base_.param_scheduler[1]]
train_cfg = dict(max_epochs=6, val_interval=1)
