# The small GSMap, trained with lost cameras, so that it does without some.
_base_ = '../../../configs/maptr/maptr_r18_minicity.py'

_drop = dict(type='DropCameras', prob=0.3, max_num=3)
_steps = [_base_._load, _base_._scale, _drop, _base_._targets, _base_._mask, _base_._pack]
model = dict(map_head=dict(type='GSMapHead'))
train_dataloader = dict(dataset=dict(pipeline=_steps))
