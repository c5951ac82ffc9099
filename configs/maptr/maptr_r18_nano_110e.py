# MapTR nano on nuScenes, 110 epochs, as published: ResNet-18 with trained BatchNorm, images at 0.2 of their size, BEV
# 80 x 40, 100 instances, two decoder layers of four heads, AdamW 4e-3 for 24 x 8 samples per step.
_base_ = './maptr_r50_24e.py'

model = dict(
    img_backbone=dict(
        depth=18, frozen_stages=-1, norm_eval=False, norm_cfg=dict(requires_grad=True),
        init_cfg=dict(checkpoint='https://download.pytorch.org/models/resnet18-f37072fd.pth')),
    img_neck=dict(in_channels=[512]),
    bev_encoder=dict(bev_pixel_m=0.75),
    map_head=dict(query_groups=[dict(num=100)], decoder=dict(num_layers=2, layer=dict(num_heads=4))))
_scale = dict(type='ScaleImages', scale=0.2)
_steps = [_base_._load_bytes, _base_._photometric, _scale, _base_._targets, _base_._pack]
train_dataloader = dict(batch_size=24, dataset=dict(pipeline=_steps))
val_dataloader = dict(dataset=dict(pipeline=[_base_._load, _scale, _base_._pack]))
test_dataloader = val_dataloader
optim_wrapper = dict(optimizer=dict(lr=4e-3), clip_grad=dict(max_norm=50))
train_cfg = dict(max_epochs=110)
auto_scale_lr = dict(base_batch_size=192)
sync_bn = 'torch'  # of several ranks
