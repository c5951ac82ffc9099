# MapVR on MapTR, ResNet-50, nuScenes, 24 epochs: the paper's Tables 1 and 5.
_base_ = '../maptr/maptr_r50_24e.py'

model = dict(
    bev_encoder=dict(layer_cfg=dict(dropout=0.0)), map_head=dict(type='MapVRHead'))
