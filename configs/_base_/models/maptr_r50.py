# MapTR with ResNet-50 and geometry kernel attention, as published (tiny): 35.92 M trainable parameters.
# The backbone's weights are fetched; without a network see docs/install.md#weights-of-backbones.
model = dict(
    type='MapDetector',
    data_preprocessor=dict(
        type='MapDataPreprocessor',
        mean=[123.675, 116.28, 103.53],
        std=[58.395, 57.12, 57.375],
        bgr_to_rgb=True,
        pad_size_divisor=32),
    img_augment=dict(type='GridMask', prob=0.7, ratio=0.5),
    img_backbone=dict(
        type='mmdet.ResNet',
        depth=50,
        num_stages=4,
        out_indices=(3,),
        frozen_stages=1,
        norm_cfg=dict(type='BN', requires_grad=False),
        norm_eval=True,
        style='pytorch',
        init_cfg=dict(type='Pretrained', checkpoint='https://download.pytorch.org/models/resnet50-19c8e357.pth')),
    img_neck=dict(
        type='mmdet.FPN',
        in_channels=[2048],
        out_channels=256,
        add_extra_convs='on_output',
        num_outs=1,
        relu_before_extra_convs=True),
    bev_encoder=dict(
        type='BEVQueryEncoder',
        cross_attn=dict(type='GeometryKernelAttention', num_heads=4, kernel_size=(3, 5)),
        z_range=(-2.0, 2.0),
        bev_pixel_m=0.3,
        embed_dims=256,
        num_layers=1,
        layer_cfg=dict(num_heads=8, ffn_dims=512, dropout=0.1),
        num_cams=6),
    map_head=dict(
        type='MapHead',
        query_groups=[dict(num=50)],
        num_points=20,
        embed_dims=256,
        decoder=dict(num_layers=6, layer=dict(num_heads=8, ffn_dims=512, dropout=0.1)),
        match_costs=[
            dict(type='mmdet.FocalLossCost', weight=2.0),
            dict(type='OrderedPointsCost', weight=5.0),
        ],
        loss_cls=dict(
            type='mmdet.FocalLoss', use_sigmoid=True, gamma=2.0, alpha=0.25, loss_weight=2.0),
        losses=[
            dict(type='PointsLoss', loss_weight=5.0),
            dict(type='DirectionLoss', loss_weight=0.005),
        ],
        coder=dict(max_num=50)))
