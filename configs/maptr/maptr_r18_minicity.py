# A small MapTR for MiniCity, trained from scratch on two CPU cores. As no pretrained backbone is at hand, an auxiliary BEV
# mask (as in MapTRv2) teaches it to see; it adds nothing at inference.
_base_ = [
    '../_base_/datasets/minicity_seg.py',
    '../_base_/models/maptr_r18_minicity.py',
    '../_base_/schedules/minicity.py',
    '../_base_/default_runtime.py',
]

model = dict(
    grid=_base_.grid,
    classes=_base_.classes,
    map_head=dict(aux_heads=[dict(type='BEVMaskHead', loss_weight=2.0, pos_weight=4.0)]))
