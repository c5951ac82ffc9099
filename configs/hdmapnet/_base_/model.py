# HDMapNet of cameras as published: 75.26 M parameters that do something, 65 M of them learn what each camera sees from
# above.
_weights = 'https://github.com/lukemelas/EfficientNet-PyTorch/releases/download/1.0/efficientnet-b0-355c32eb.pth'
model = dict(
    type='MapDetector',
    data_preprocessor=dict(
        type='MapDataPreprocessor',
        mean=[123.675, 116.28, 103.53],
        std=[58.395, 57.12, 57.375],
        bgr_to_rgb=True,
        pad_size_divisor=32),
    img_backbone=dict(
        type='mmdet.EfficientNet',
        arch='b0',
        drop_path_rate=0.1875,  # of the last of 16 blocks: 0.2 x 15 / 16, what the trunk has by default
        out_indices=(4, 5),
        norm_eval=False,
        init_cfg=dict(type='Pretrained', checkpoint=_weights)),
    img_neck=dict(type='JoinLevels', in_channels=(112, 320), out_channels=64),
    bev_encoder=dict(type='ViewTransformEncoder', image_size=(128, 352), stride=16, bev_pixel_m=0.3),
    map_head=dict(type='HDMapNetHead', embed_dims=64))
