# A small MapTR with cameras and LiDAR for MiniCity.
_base_ = [
    '../_base_/datasets/minicity.py', '../_base_/models/maptr_r50.py', '../_base_/models/minicity.py',
    '../_base_/models/pointpillars.py',
    '../_base_/schedules/minicity.py', '../_base_/default_runtime.py',
]
_base_.model.merge(_base_._minicity)
_base_.model.merge(_base_._pointpillars)
_base_.model.merge(_base_._pointpillars_minicity)

model = dict(grid=_base_.grid, classes=_base_.classes)
train_dataloader = dict(dataset=dict(pipeline=_base_._lidar))
val_dataloader = dict(dataset=dict(pipeline=_base_._lidar_test))
test_dataloader = val_dataloader
