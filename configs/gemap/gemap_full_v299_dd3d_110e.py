# GeMap with its full objective on nuScenes, V2-99 that learned depth first (DD3D), 110 epochs, 4 x 8 samples per step.
_base_ = './gemap_full_r50_110e.py'

_dd3d = 'https://tri-ml-public.s3.amazonaws.com/github/dd3d/pretrained/' \
    'depth_pretrained_v99-3jlw0p36-20210423_010520-model_final-remapped.pth'
model = dict(
    img_backbone=dict(
        _delete_=True, type='VoVNet', depth=99, out_indices=(3,), norm_eval=True, frozen_stages=1,
        init_cfg=dict(type='Pretrained', checkpoint=_dd3d)),
    img_neck=dict(in_channels=[1024]))
