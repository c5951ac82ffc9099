# As published by MapTR: AdamW 6e-4 for 32 samples per step, warm-up over 500 iterations, cosine decay per epoch over
# all epochs: 24, or the train_cfg = dict(max_epochs=...) of a leaf. Mixed precision: tools/train.py --amp, or
# optim_wrapper.type='AmpOptimWrapper'.
optim_wrapper = dict(
    type='MapOptimWrapper',
    constructor='MergedGroupsConstructor',
    optimizer=dict(type='AdamW', lr=6e-4, weight_decay=0.01),
    paramwise_cfg=dict(custom_keys=dict(img_backbone=dict(lr_mult=0.1))),
    clip_grad=dict(max_norm=35, norm_type=2))
param_scheduler = [
    dict(type='LinearLR', start_factor=1.0 / 3, by_epoch=False, begin=0, end=500),
    dict(type='CosineAnnealingLR', by_epoch=True, eta_min_ratio=1e-3),
]
train_cfg = dict(type='EpochBasedTrainLoop', max_epochs=24, val_interval=2)
val_cfg = dict()
test_cfg = dict()
auto_scale_lr = dict(enable=False, base_batch_size=32)
