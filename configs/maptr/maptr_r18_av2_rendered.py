# A small MapTR on rendered Argoverse 2 logs, trained from scratch on two CPU cores; the BEV mask as on MiniCity.
_base_ = [
    '../_base_/datasets/av2_rendered.py',
    '../_base_/models/maptr_r18_av2_rendered.py',
    '../_base_/schedules/minicity.py',
    '../_base_/default_runtime.py',
]

model = dict(
    grid=_base_.grid,
    classes=_base_.classes,
    map_head=dict(aux_heads=[dict(type='BEVMaskHead', loss_weight=2.0, pos_weight=4.0)]))
