# MapTR with ResNet-18; torchvision://resnet18 is fetched, as in maptr_r50.py.
_base_ = './maptr_r50.py'

model = dict(
    img_backbone=dict(
        depth=18, init_cfg=dict(type='Pretrained', checkpoint='torchvision://resnet18')),
    img_neck=dict(in_channels=[512]))
