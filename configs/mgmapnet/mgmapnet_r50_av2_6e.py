# MGMapNet on Argoverse 2, 6 epochs, 8 x 2 samples per step; neither epochs nor rate were published.
_base_ = [
    '../_base_/datasets/av2_seg.py',
    '../_base_/models/mgmapnet_r50_av2.py',
    '../_base_/schedules/cosine_6e.py',
    '../_base_/default_runtime.py',
]
model = dict(grid=_base_.grid, classes=_base_.classes)
train_dataloader = dict(batch_size=2)
optim_wrapper = dict(optimizer=dict(lr=4e-4))
auto_scale_lr = dict(base_batch_size=16)
