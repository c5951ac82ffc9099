# GeMap with its full objective on nuScenes, ResNet-50, 110 epochs, 4 x 8 samples per step.
_base_ = [
    '../_base_/datasets/nuscenes_depth_seg.py',
    '../_base_/models/gemap_full_r50.py',
    '../_base_/schedules/cosine_110e.py',
    '../_base_/default_runtime.py',
]

model = dict(
    grid=_base_.grid,
    classes=_base_.classes)
optim_wrapper = dict(optimizer=dict(weight_decay=0.03))
