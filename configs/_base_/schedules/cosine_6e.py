# The schedule of 24 epochs over 6.
_base_ = './cosine_24e.py'

param_scheduler = [
    _base_.param_scheduler[0],
    dict(type='CosineAnnealingLR', by_epoch=True, T_max=6, eta_min_ratio=1e-3),
]
train_cfg = dict(max_epochs=6)
