# MapTR tiny on nuScenes with the six classes of MapVR's extended set, 24 epochs.
_base_ = [
    '../_base_/datasets/nuscenes_extended.py',
    '../_base_/models/maptr_r50.py',
    '../_base_/schedules/cosine_24e.py',
    '../_base_/default_runtime.py',
]
model = dict(grid=_base_.grid, classes=_base_.classes)
