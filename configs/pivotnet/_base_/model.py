# PivotNet with ResNet-50 as published: 49.24 M trainable parameters.
model = dict(
    type='MapDetector',
    data_preprocessor=dict(
        type='MapDataPreprocessor',
        mean=[123.675, 116.28, 103.53],
        std=[58.395, 57.12, 57.375],
        bgr_to_rgb=False,  # the release swaps the channels of RGB images: BGR with the means of RGB
        pad_size_divisor=32),
    img_backbone=dict(
        type='mmdet.ResNet',
        depth=50,
        num_stages=4,
        out_indices=(2, 3),
        frozen_stages=-1,
        norm_cfg=dict(type='BN', requires_grad=True),
        norm_eval=True,
        style='pytorch',
        init_cfg=dict(type='Pretrained', checkpoint='https://download.pytorch.org/models/resnet50-0676ba61.pth')),
    bev_encoder=dict(type='PivotBEVEncoder'),
    map_head=dict(type='PivotHead', queries=((20, 10), (25, 2), (15, 30)), decoder=dict(num_layers=6)))

# of a segmentation model (UperNet on ADE20K), as in the release
_swin = 'https://github.com/SwinTransformer/storage/releases/download/v1.0.1/upernet_swin_tiny_patch4_window7_512x512.pth'
_swin_t = dict(  # what Swin-T changes
    img_backbone=dict(
        _delete_=True, type='mmdet.SwinTransformer', embed_dims=96, depths=(2, 2, 6, 2), num_heads=(3, 6, 12, 24),
        window_size=7, drop_path_rate=0.3, out_indices=(2, 3), convert_weights=True,
        init_cfg=dict(type='Pretrained', checkpoint=_swin)),
    bev_encoder=dict(in_channels=(384, 768)))
