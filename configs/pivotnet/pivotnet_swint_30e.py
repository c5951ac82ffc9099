# PivotNet on nuScenes, Swin-T, 30 epochs, as published.
_base_ = './pivotnet_r50_30e.py'

_swin = 'https://github.com/SwinTransformer/storage/releases/download/v1.0.0/swin_tiny_patch4_window7_224.pth'
model = dict(
    img_backbone=dict(
        _delete_=True, type='mmdet.SwinTransformer', embed_dims=96, depths=(2, 2, 6, 2), num_heads=(3, 6, 12, 24),
        window_size=7, drop_path_rate=0.1, out_indices=(2, 3), convert_weights=True,
        init_cfg=dict(type='Pretrained', checkpoint=_swin)),
    bev_encoder=dict(in_channels=(384, 768)))
