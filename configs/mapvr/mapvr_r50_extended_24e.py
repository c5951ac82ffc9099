# MapVR on nuScenes with its extended set of six classes, 24 epochs: the paper's Table 2.
_base_ = '../maptr/maptr_r50_extended_24e.py'

model = dict(
    bev_encoder=dict(layer_cfg=dict(dropout=0.0)), map_head=dict(type='MapVRHead'))
