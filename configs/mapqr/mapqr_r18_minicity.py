# A small MapQR for MiniCity, trained from scratch on two CPU cores. As in the other small models, points gather in
# fewer channels and masks in the cameras are at stride 8.
_base_ = [
    '../_base_/datasets/minicity.py', '../_base_/models/maptr_r50.py', '../_base_/models/minicity.py',
    './_base_/model.py', '../_base_/schedules/minicity.py', '../_base_/default_runtime.py',
]
_base_.model.merge(_base_._minicity)
_base_.model.merge(_base_._mapqr)

model = dict(
    grid=_base_.grid, classes=_base_.classes,
    bev_encoder=dict(  # the lowest pillar height is the ground, at the end of the range
        num_layers=1, z_range=(-1.84, 0.16), cross_attn=dict(num_heads=4)),
    map_head=dict(
        query_groups=[  # as many queries per repeat as one to one, as published
            dict(num=20), dict(name='one2many', num=40, repeats=2, weight=1.0)]))
train_dataloader = dict(batch_size=2, dataset=dict(pipeline=_base_._seg))
