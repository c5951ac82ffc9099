# MapTR with cameras and LiDAR (SECOND) on nuScenes, 24 epochs; trains on a GPU, tests on a CPU with spconv.
_base_ = [
    '../_base_/datasets/nuscenes.py', '../_base_/models/maptr_r50.py', '../_base_/models/second.py',
    '../_base_/schedules/cosine.py', '../_base_/default_runtime.py',
]
_base_.model.merge(_base_._second)

model = dict(grid=_base_.grid, classes=_base_.classes)
train_dataloader = dict(dataset=dict(pipeline=_base_._lidar))
val_dataloader = dict(dataset=dict(pipeline=_base_._lidar_test))
test_dataloader = val_dataloader
