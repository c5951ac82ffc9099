# BeMapNet on nuScenes, EfficientNet-B0, 30 epochs, as published but for random mirroring.
_base_ = './bemapnet_r50_30e.py'

_weights = 'https://github.com/lukemelas/EfficientNet-PyTorch/releases/download/1.0/efficientnet-b0-355c32eb.pth'
model = dict(
    img_backbone=dict(
        _delete_=True, type='mmdet.EfficientNet', arch='b0', out_indices=(3, 4, 5), norm_eval=False,
        drop_path_rate=0.1875,  # of the last of 16 blocks: 0.2 x 15 / 16, as in the release
        init_cfg=dict(type='Pretrained', checkpoint=_weights)),
    img_neck=dict(in_channels=(40, 112, 320), channels=128),
    bev_encoder=dict(in_channels=640))
