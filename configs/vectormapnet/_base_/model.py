# VectorMapNet with ResNet-50 as published: 36.73 M trainable parameters. The weights of ResNet-50
# are detectron2's (caffe), fetched; without a network see docs/install.md#weights-of-backbones.
model = dict(
    type='MapDetector',
    data_preprocessor=dict(
        type='MapDataPreprocessor',
        mean=[103.53, 116.28, 123.675],
        std=[1.0, 1.0, 1.0],
        bgr_to_rgb=False,
        pad_size_divisor=32),
    img_backbone=dict(
        type='mmdet.ResNet',
        depth=50,
        num_stages=4,
        out_indices=(0, 1, 2, 3),
        frozen_stages=-1,
        norm_cfg=dict(type='BN', requires_grad=True),
        norm_eval=True,
        style='caffe',
        dcn=dict(type='DCNv2', deform_groups=1, fallback_on_stride=False),
        stage_with_dcn=(False, False, True, True),
        init_cfg=dict(type='Pretrained', checkpoint='https://download.openmmlab.com/pretrain/third_party/resnet50_msra-5891d200.pth')),
    img_neck=dict(
        type='mmdet.FPN',
        in_channels=[256, 512, 1024, 2048],
        out_channels=128,
        num_outs=4,
        norm_cfg=dict(type='BN')),
    bev_encoder=dict(type='HeightPlanesEncoder', heights_m=(-1.1, 0.0, 0.5, 1.1), bev_pixel_m=0.3),
    map_head=dict(
        type='VectorMapNetHead',
        detector=dict(type='KeyPointHead', num_queries=120, decoder=dict(num_layers=6), coder=dict(max_num=35)),
        generator=dict(num_layers=6, top_p=0.9, max_points=64, redraw=True)))
