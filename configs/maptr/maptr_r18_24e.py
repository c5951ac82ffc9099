# MapTR with ResNet-18 on nuScenes, 24 epochs.
_base_ = './maptr_r50_24e.py'

model = dict(
    img_backbone=dict(depth=18, init_cfg=dict(checkpoint='https://download.pytorch.org/models/resnet18-f37072fd.pth')),
    img_neck=dict(in_channels=[512]))
