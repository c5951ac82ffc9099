# A small MGMapNet for MiniCity, trained from scratch on two CPU cores with LiDAR depth.
_base_ = [
    '../_base_/datasets/minicity.py', '../_base_/models/maptr_r50.py', '../_base_/models/minicity.py',
    '../maptrv2/_base_/model.py', './_base_/model.py',
    '../_base_/schedules/minicity.py', '../_base_/default_runtime.py',
]
_base_.model.merge(_base_._minicity)
_base_.model.merge(_base_._maptrv2)
_base_.model.merge(_base_._maptrv2_minicity)
_base_.model.merge(_base_._mgmapnet)

model = dict(
    grid=_base_.grid, classes=_base_.classes, bev_encoder=dict(bev_pixel_m=1.25),  # two levels need even sides
    map_head=dict(
        query_groups=[  # as many queries per repeat as one to one, as released
            dict(num=40), dict(name='one2many', num=80, repeats=2, weight=1.0)],
        decoder=dict(  # interactions are four times as wide as the queries, as released
            num_layers=2,
            layer=dict(num_heads=4, ffn_dims=256, dropout=0.0, cross_attn=dict(ffn_dims=512))),
        masks=dict(pixel_m=0.625)))
_mask = dict(type='MakeBEVMask', size=(48, 24), num_classes=3)
train_dataloader = dict(dataset=dict(pipeline=[*_base_._depth_seg[:7], _mask, *_base_._depth_seg[8:]]))
