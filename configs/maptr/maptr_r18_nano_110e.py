# MapTR nano on nuScenes, 110 epochs, as published: images at 0.2 of their size, 24 x 8 samples per step.
_base_ = [
    '../_base_/datasets/nuscenes_scale02.py',
    '../_base_/models/maptr_r18_nano.py',
    '../_base_/schedules/cosine_110e_nano.py',
    '../_base_/default_runtime.py',
]
model = dict(grid=_base_.grid, classes=_base_.classes)
