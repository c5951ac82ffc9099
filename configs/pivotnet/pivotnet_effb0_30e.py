# PivotNet on nuScenes, EfficientNet-B0, 30 epochs, as published.
_base_ = './pivotnet_r50_30e.py'

_weights = 'https://download.openmmlab.com/mmclassification/v0/efficientnet/efficientnet-b0_3rdparty_8xb32-aa_in1k_20220119-8d939117.pth'
model = dict(
    img_backbone=dict(
        _delete_=True, type='mmdet.EfficientNet', arch='b0', out_indices=(4, 5), norm_eval=True,
        init_cfg=dict(type='Pretrained', prefix='backbone', checkpoint=_weights)),
    bev_encoder=dict(in_channels=(112, 320)))
