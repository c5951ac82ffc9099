# MapVR on MapTR, Argoverse 2, 6 epochs: the paper's Table 3.
_base_ = '../maptr/maptr_r50_av2_6e.py'

model = dict(
    bev_encoder=dict(layer_cfg=dict(dropout=0.0)), map_head=dict(type='MapVRHead'))
