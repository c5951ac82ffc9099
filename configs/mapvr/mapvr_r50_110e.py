# MapVR on MapTR, ResNet-50, nuScenes, 110 epochs: the paper's Table 1.
_base_ = '../maptr/maptr_r50_110e.py'

model = dict(
    bev_encoder=dict(layer_cfg=dict(dropout=0.0)), map_head=dict(type='MapVRHead'))
train_cfg = dict(val_interval=10)
