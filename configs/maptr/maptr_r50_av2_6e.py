# MapTR on Argoverse 2, 6 epochs, 6 x 8 samples per step.
_base_ = [
    '../_base_/datasets/av2.py',
    '../_base_/models/maptr_r50_av2.py',
    '../_base_/schedules/cosine_6e.py',
    '../_base_/default_runtime.py',
]
auto_scale_lr = dict(base_batch_size=48)
model = dict(grid=_base_.grid, classes=_base_.classes)
