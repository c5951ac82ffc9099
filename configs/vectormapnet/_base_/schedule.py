# As published by VectorMapNet: AdamW 1e-3 with 5 samples per GPU, a tenth of it after 100 and after 120 of 130 epochs,
# warm-up over 400 iterations. Its release does not say the number of GPUs; 8 are assumed. A tenth of the learning rate
# holds for what it calls backbone: all before its BEV neck.
optim_wrapper = dict(
    type='MapOptimWrapper',
    constructor='MergedGroupsConstructor',
    optimizer=dict(type='AdamW', lr=1e-3, weight_decay=0.01),
    paramwise_cfg=dict(
        custom_keys={
            'img_backbone': dict(lr_mult=0.1),
            'img_neck': dict(lr_mult=0.1),
            'bev_encoder.upsampling': dict(lr_mult=0.1),
            'bev_encoder.reduction': dict(lr_mult=0.1),
        }),
    clip_grad=dict(max_norm=0.5, norm_type=2))
param_scheduler = [
    dict(type='LinearLR', start_factor=0.1, by_epoch=False, begin=0, end=400),
    dict(type='MultiStepLR', by_epoch=True, milestones=[100, 120], gamma=0.1),
]
train_cfg = dict(type='EpochBasedTrainLoop', max_epochs=130, val_interval=1)
val_cfg = dict()
test_cfg = dict()
auto_scale_lr = dict(enable=False, base_batch_size=40)
