# GeMap with its full objective on Argoverse 2, 24 epochs, 4 x 8 samples per step; as published without depth.
_base_ = [
    '../_base_/datasets/av2_seg.py',
    '../_base_/models/maptrv2_r50_av2.py',
    '../_base_/schedules/cosine_24e.py',
    '../_base_/default_runtime.py',
]

model = dict(
    grid=_base_.grid,
    classes=_base_.classes,
    img_backbone=dict(frozen_stages=-1),
    map_head=dict(
        type='GeMapHead',
        query_groups=[dict(num=50)],
        decoder=dict(layer=dict(self_attn=dict(type='GeometryDecoupledAttention'))),
        aux_heads=_base_.model.map_head.aux_heads[:2]))
optim_wrapper = dict(optimizer=dict(weight_decay=0.03))
param_scheduler = [dict(_base_.param_scheduler[0], end=200), _base_.param_scheduler[1]]
train_dataloader = dict(batch_size=4)
