# As published by HDMapNet: Adam 1e-3 for 4 samples per step, a tenth of it after every 10 of 30 epochs.
optim_wrapper = dict(
    type='MapOptimWrapper',
    constructor='MergedGroupsConstructor',
    optimizer=dict(type='Adam', lr=1e-3, weight_decay=1e-7),
    clip_grad=dict(max_norm=5, norm_type=2))
param_scheduler = [dict(type='StepLR', by_epoch=True, step_size=10, gamma=0.1)]
train_cfg = dict(type='EpochBasedTrainLoop', max_epochs=30, val_interval=5)
val_cfg = dict()
test_cfg = dict()
auto_scale_lr = dict(enable=False, base_batch_size=4)
