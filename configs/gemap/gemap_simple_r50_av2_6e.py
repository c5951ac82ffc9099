# GeMap with its simple objective on Argoverse 2, 6 epochs, 4 x 8 samples per step.
_base_ = [
    '../_base_/datasets/av2.py',
    '../_base_/models/gemap_simple_r50_av2.py',
    '../_base_/schedules/cosine_6e.py',
    '../_base_/default_runtime.py',
]

model = dict(grid=_base_.grid, classes=_base_.classes)
optim_wrapper = dict(optimizer=dict(weight_decay=0.03))
param_scheduler = [dict(_base_.param_scheduler[0], end=200), _base_.param_scheduler[1]]
train_dataloader = dict(batch_size=4)
