# MapTR tiny on nuScenes, 24 epochs, as published.
_base_ = [
    '../_base_/datasets/nuscenes.py', '../_base_/models/maptr_r50.py',
    '../_base_/schedules/cosine.py', '../_base_/default_runtime.py',
]

model = dict(grid=_base_.grid, classes=_base_.classes)
