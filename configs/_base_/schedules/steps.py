# As published for heads of lines with masks: AdamW 2e-4 for 8 samples per step, a fifth of it after 70 % and 90 % of 30 epochs, neither
# warm-up nor clipping. The release gives a weight decay of 1e-4 under a name that AdamW does not know, so it is 0.01.
optim_wrapper = dict(
    type='MapOptimWrapper',
    constructor='MergedGroupsConstructor',
    optimizer=dict(type='AdamW', lr=2e-4, weight_decay=0.01),
    paramwise_cfg=dict(custom_keys=dict(img_backbone=dict(lr_mult=0.25))))
param_scheduler = [dict(type='MultiStepLR', by_epoch=True, milestones=[21, 27], gamma=0.2)]
train_cfg = dict(type='EpochBasedTrainLoop', max_epochs=30, val_interval=5)
val_cfg = dict()
test_cfg = dict()
auto_scale_lr = dict(enable=False, base_batch_size=8)
