# A small MapTR for MiniCity, trained from scratch on two CPU cores. As no pretrained backbone is at hand, an auxiliary
# BEV mask teaches it to see; it adds nothing at inference.
_base_ = [
    '../_base_/datasets/minicity.py', '../_base_/models/maptr_r50.py', '../_base_/models/minicity.py',
    '../_base_/schedules/minicity.py', '../_base_/default_runtime.py',
]
_base_.model.merge(_base_._minicity)

model = dict(
    grid=_base_.grid, classes=_base_.classes,
    map_head=dict(aux_heads=[dict(type='BEVMaskHead', loss_weight=2.0, pos_weight=4.0)]))

_mask = dict(type='MakeBEVMask', size=(50, 25), thickness_px=1)
_steps = [_base_._load, _base_._scale, _base_._targets, _mask, _base_._pack]
train_dataloader = dict(batch_size=2, dataset=dict(pipeline=_steps))
