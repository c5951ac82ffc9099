# A small MGMap for MiniCity, trained from scratch on two CPU cores, whose refinement sees patches and whose masks are
# not mirrored.
_base_ = [
    '../_base_/datasets/minicity.py', '../_base_/models/maptr_r50.py', '../_base_/models/minicity.py',
    './_base_/model.py', '../_base_/schedules/minicity.py', '../_base_/default_runtime.py',
]
_base_.model.merge(_base_._minicity)
_base_.model.merge(_base_._mgmap)

model = dict(
    grid=_base_.grid, classes=_base_.classes,
    map_head=dict(decoder=dict(num_masks=20, patches=True, refine_ffn_dims=512)))
_own_masks = dict(type='MakeInstanceMasks', size=(50, 25), thickness_px=1, gap_px=2, mirrored=False)
_steps = [_base_._load, _base_._scale, _base_._targets, _own_masks, _base_._pack]
train_dataloader = dict(batch_size=2, dataset=dict(pipeline=_steps))
