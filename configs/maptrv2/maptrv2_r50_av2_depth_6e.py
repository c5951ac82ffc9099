# MapTRv2 on Argoverse 2 with depth supervision by LiDAR, 6 epochs, 4 x 8 samples per step.
_base_ = './maptrv2_r50_av2_6e.py'

model = dict(map_head=dict(aux_heads=_base_._maptrv2.map_head.aux_heads))
train_dataloader = dict(dataset=dict(pipeline=_base_._depth_seg))
