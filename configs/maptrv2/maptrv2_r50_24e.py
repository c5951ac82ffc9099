# MapTRv2 on nuScenes as published: ResNet-50, 24 epochs, 4 x 8 samples per step.
_base_ = [
    '../_base_/datasets/nuscenes_depth_seg.py',
    '../_base_/models/maptrv2_r50.py',
    '../_base_/schedules/cosine_24e.py',
    '../_base_/default_runtime.py',
]
model = dict(grid=_base_.grid, classes=_base_.classes)
