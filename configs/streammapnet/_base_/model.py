# What StreamMapNet has in place of MapTR's parts (maptr_r50.py), as published: three levels of a backbone with
# deformable convolutions, one query per element, memory of BEV and of queries. The
# weights of ResNet-50 are detectron2's (caffe), fetched; without a network see docs/install.md#weights-of-backbones.
_streammapnet = dict(
    data_preprocessor=dict(mean=[103.53, 116.28, 123.675], std=[1.0, 1.0, 1.0], bgr_to_rgb=False),
    img_backbone=dict(
        out_indices=(1, 2, 3),
        frozen_stages=-1,
        norm_cfg=dict(requires_grad=True),
        style='caffe',
        dcn=dict(type='DCNv2', deform_groups=1, fallback_on_stride=False),
        stage_with_dcn=(False, False, True, True),
        init_cfg=dict(checkpoint='https://download.openmmlab.com/pretrain/third_party/resnet50_msra-5891d200.pth')),
    img_neck=dict(
        _delete_=True,
        type='mmdet.FPN',
        in_channels=[512, 1024, 2048],
        out_channels=256,
        num_outs=3,
        norm_cfg=dict(type='BN')),
    bev_encoder=dict(
        _delete_=True,
        type='StreamMapNetEncoder',
        cross_attn=dict(
            type='SpatialCrossAttention', num_heads=8, num_points=8, num_heights=4, num_levels=3),
        z_range=(-11 / 3, 17 / 3),  # four slices, whose middles are -2.5 to 4.5 m
        bev_pixel_m=0.6,
        embed_dims=256,
        layer_cfg=dict(num_heads=8, ffn_dims=512, dropout=0.1),
        num_cams=6),
    map_head=dict(
        type='StreamMapNetHead',
        query_groups=[dict(num=100)],
        decoder=dict(layer=dict(ffn_dims=1024)),
        match_costs=[
            dict(type='mmdet.FocalLossCost', weight=5.0),
            dict(type='SmoothPointsCost', weight=50.0),
        ],
        loss_cls=dict(loss_weight=5.0),
        losses=[dict(type='SmoothPointsLoss', loss_weight=50.0)],
        coder=dict(max_num=100)),
    temporal=dict(bev=dict(), queries=dict(num=33)))
# As published: 5e-4 for 32 samples per step, cosine decay per iteration.
_optim_wrapper = dict(optimizer=dict(lr=5e-4))
_param_scheduler = [
    dict(type='LinearLR', start_factor=1.0 / 3, by_epoch=False, begin=0, end=500),
    dict(type='CosineAnnealingLR', by_epoch=True, eta_min_ratio=3e-3, convert_to_iter_based=True),
]
