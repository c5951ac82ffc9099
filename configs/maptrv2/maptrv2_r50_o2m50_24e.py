# MapTRv2 with 50 one-to-many queries, the baseline of GSMap's Table 3, which does not name k: 6 as in MapTRv2.
_base_ = [
    '../_base_/datasets/nuscenes.py', '../_base_/models/maptr_r50.py', './_base_/model.py',
    '../_base_/schedules/cosine.py', '../_base_/default_runtime.py',
]
_base_.model.merge(_base_._maptrv2)

model = dict(
    grid=_base_.grid, classes=_base_.classes,
    map_head=dict(
        query_groups=[dict(num=50), dict(name='one2many', num=50, repeats=6, weight=1.0)]))
train_dataloader = dict(dataset=dict(pipeline=_base_._depth_seg))
