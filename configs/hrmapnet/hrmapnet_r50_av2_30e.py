# HRMapNet on MapTRv2, Argoverse 2 at 2 Hz, 30 epochs, 4 x 8 samples per step. The annotation files are made with
# `--rate 2hz --tag _2hz`.
_base_ = [
    '../_base_/datasets/av2.py', '../_base_/models/maptr_r50.py', '../maptrv2/_base_/model.py',
    './_base_/model.py', '../_base_/schedules/cosine.py', '../_base_/default_runtime.py',
]
_base_.model.merge(_base_._maptrv2)
_base_.model.merge(_base_._hrmapnet)

model = dict(
    grid=_base_.grid, classes=_base_.classes, bev_encoder=dict(z_range=(-5.0, 3.0)),
    prior=dict(bev=dict(layer=dict(num_cams=7))), map_head=dict(aux_heads=_base_._maptrv2.map_head.aux_heads[:2]))
_train = dict(rate_hz=2.0, ann_file='gsmap_av2_train_2hz.arrow', pipeline=_base_._seg)
train_dataloader = dict(batch_size=4, dataset=_train)
val_dataloader = dict(dataset=dict(ann_file='gsmap_av2_val_2hz.arrow'))
test_dataloader = val_dataloader
param_scheduler = [dict(_base_.param_scheduler[0], end=200), _base_.param_scheduler[1]]
train_cfg = dict(max_epochs=30, val_interval=5)
