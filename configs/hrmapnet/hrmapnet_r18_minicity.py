# A small HRMapNet on MapTRv2 for MiniCity, trained from scratch on two CPU cores with LiDAR depth.
_base_ = [
    '../_base_/datasets/minicity.py', '../_base_/models/maptr_r50.py', '../_base_/models/minicity.py',
    '../maptrv2/_base_/model.py', './_base_/model.py',
    '../_base_/schedules/minicity.py', '../_base_/default_runtime.py',
]
_base_.model.merge(_base_._minicity)
_base_.model.merge(_base_._maptrv2)
_base_.model.merge(_base_._maptrv2_minicity)
_base_.model.merge(_base_._hrmapnet)
_base_.model.merge(_base_._hrmapnet_minicity)

model = dict(grid=_base_.grid, classes=_base_.classes)
train_dataloader = dict(dataset=dict(pipeline=_base_._depth_seg))
