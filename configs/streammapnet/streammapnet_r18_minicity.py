# A small StreamMapNet for MiniCity, trained from scratch on two CPU cores, one epoch of single frames first.
_base_ = [
    '../_base_/datasets/minicity.py', '../_base_/models/maptr_r50.py', '../_base_/models/minicity.py',
    '../_base_/schedules/minicity.py', '../_base_/default_runtime.py',
]
_base_.model.merge(_base_._minicity)

_losses = dict(
    match_costs=[dict(type='mmdet.FocalLossCost', weight=5.0), dict(type='SmoothPointsCost')],
    losses=[dict(type='SmoothPointsLoss')], loss_cls=dict(loss_weight=5.0))
model = dict(
    grid=_base_.grid, classes=_base_.classes, temporal=dict(bev=dict(), queries=dict(num=7), embed_dims=128),
    map_head=dict(
        type='StreamMapNetHead', aux_heads=[dict(type='BEVMaskHead', embed_dims=128, pos_weight=4.0)], **_losses))
_mask = dict(type='MakeBEVMask', size=(50, 25), thickness_px=1)
_steps = [_base_._load, _base_._scale, dict(_base_._targets, orders_of='points'), _mask, _base_._pack]
train_dataloader = dict(
    batch_size=2, dataset=dict(pipeline=_steps),
    sampler=dict(_delete_=True, type='StreamTrainSampler', slots=2, single_frame_iters=500))
val_dataloader = dict(sampler=dict(_delete_=True, type='StreamTestSampler'))
test_dataloader = val_dataloader
