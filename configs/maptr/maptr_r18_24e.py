# MapTR with ResNet-18 on nuScenes, 24 epochs.
_base_ = [
    '../_base_/datasets/nuscenes.py',
    '../_base_/models/maptr_r18.py',
    '../_base_/schedules/cosine_24e.py',
    '../_base_/default_runtime.py',
]
model = dict(grid=_base_.grid, classes=_base_.classes)
