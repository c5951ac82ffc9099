# The small GSMap on four samples of MiniCity, trained and tested on the same four: can it learn them by heart?
_base_ = '../../../configs/maptr/maptr_r18_minicity.py'

model = dict(map_head=dict(type='GSMapHead'))
_four = dict(indices=4)
optim_wrapper = dict(optimizer=dict(lr=1.2e-3))
train_dataloader = dict(batch_size=4, dataset=_four)
val_dataloader = dict(
    dataset=dict(ann_file='gsmap_minicity_train.arrow', split='train', **_four))
test_dataloader = val_dataloader
param_scheduler = [
    dict(type='LinearLR', start_factor=0.1, by_epoch=False, begin=0, end=50),
    dict(type='CosineAnnealingLR', by_epoch=True, eta_min_ratio=1e-2),
]
train_cfg = dict(max_epochs=500, val_interval=100)
default_hooks = dict(
    checkpoint=dict(interval=100, max_keep_ckpts=1), logger=dict(interval=1))
