# A small MGMapNet for MiniCity, trained from scratch on two CPU cores with LiDAR depth.
_base_ = [
    '../_base_/datasets/minicity_depth_seg.py',
    '../_base_/models/mgmapnet_r18_minicity.py',
    '../_base_/schedules/minicity.py',
    '../_base_/default_runtime.py',
]

_mask = dict(type='MakeBEVMask', size=(48, 24), num_classes=3)
_steps = _base_.train_dataloader.dataset.pipeline
model = dict(grid=_base_.grid, classes=_base_.classes)
train_dataloader = dict(dataset=dict(pipeline=[*_steps[:6], _mask, *_steps[7:]]))
