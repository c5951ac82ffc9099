# GeMap with its simple objective for Argoverse 2, as published: the whole backbone learns.
_base_ = './maptr_r50_av2.py'

model = dict(
    img_backbone=dict(frozen_stages=-1),
    bev_encoder=dict(z_range=(-5.0, 3.0)),
    map_head=dict(
        type='GeMapHead',
        decoder=dict(layer=dict(self_attn=dict(type='GeometryDecoupledAttention')))))
