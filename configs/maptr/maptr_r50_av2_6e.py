# MapTR on Argoverse 2, 6 epochs, 6 x 8 samples per step.
_base_ = [
    '../_base_/datasets/av2.py', '../_base_/models/maptr_r50.py',
    '../_base_/schedules/cosine.py', '../_base_/default_runtime.py',
]

model = dict(grid=_base_.grid, classes=_base_.classes, bev_encoder=dict(num_cams=7))
auto_scale_lr = dict(base_batch_size=48)
train_cfg = dict(max_epochs=6)
