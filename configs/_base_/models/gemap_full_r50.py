# GeMap with its full objective: MapTRv2's encoder and auxiliary heads, one group of queries, GeMap's decoder and loss.
_base_ = './maptrv2_r50.py'

model = dict(
    img_backbone=dict(frozen_stages=-1),
    map_head=dict(
        type='GeMapHead',
        query_groups=[dict(num=50)],
        decoder=dict(layer=dict(self_attn=dict(type='GeometryDecoupledAttention')))))
