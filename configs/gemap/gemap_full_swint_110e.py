# GeMap with its full objective on nuScenes, Swin-T, 110 epochs, 3 x 8 samples per step.
_base_ = './gemap_full_r50_110e.py'

_swin = 'https://github.com/SwinTransformer/storage/releases/download/v1.0.0/swin_tiny_patch4_window7_224.pth'
model = dict(
    img_backbone=dict(
        _delete_=True, type='mmdet.SwinTransformer', embed_dims=96, depths=(2, 2, 6, 2), num_heads=(3, 6, 12, 24),
        window_size=7, drop_path_rate=0.1, out_indices=(3,), convert_weights=True,
        init_cfg=dict(type='Pretrained', checkpoint=_swin)),
    img_neck=dict(in_channels=[768]))
optim_wrapper = dict(optimizer=dict(lr=4e-4))
train_dataloader = dict(batch_size=3)
auto_scale_lr = dict(base_batch_size=24)
