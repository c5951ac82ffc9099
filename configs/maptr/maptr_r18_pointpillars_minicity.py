# A small MapTR with cameras and LiDAR for MiniCity.
_base_ = [
    '../_base_/datasets/minicity_lidar.py',
    '../_base_/models/maptr_r18_pointpillars_minicity.py',
    '../_base_/schedules/minicity.py',
    '../_base_/default_runtime.py',
]
model = dict(grid=_base_.grid, classes=_base_.classes)
