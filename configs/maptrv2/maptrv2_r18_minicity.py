# A small MapTRv2 for MiniCity, trained from scratch on two CPU cores with LiDAR depth.
_base_ = [
    '../_base_/datasets/minicity_depth_seg.py',
    '../_base_/models/maptrv2_r18_minicity.py',
    '../_base_/schedules/minicity.py',
    '../_base_/default_runtime.py',
]
model = dict(grid=_base_.grid, classes=_base_.classes)
