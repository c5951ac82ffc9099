# GeMap with its full objective on nuScenes, V2-99, 110 epochs, 3 x 8 samples per step.
_base_ = './gemap_full_r50_110e.py'

_vovnet = 'https://dl.dropbox.com/s/1mlv31coewx8trd/vovnet99_ese_detectron2.pth'  # ImageNet
model = dict(
    img_backbone=dict(
        _delete_=True, type='VoVNet', depth=99, out_indices=(3,), norm_eval=True, frozen_stages=-1,
        init_cfg=dict(type='Pretrained', checkpoint=_vovnet)),
    img_neck=dict(in_channels=[1024]))
train_dataloader = dict(batch_size=3)
auto_scale_lr = dict(base_batch_size=24)
