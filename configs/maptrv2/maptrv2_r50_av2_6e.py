# MapTRv2 on Argoverse 2, 6 epochs, 4 x 8 samples per step.
_base_ = [
    '../_base_/datasets/av2_seg.py',
    '../_base_/models/maptrv2_r50_av2.py',
    '../_base_/schedules/cosine_6e.py',
    '../_base_/default_runtime.py',
]
train_dataloader = dict(batch_size=4)
model = dict(
    grid=_base_.grid,
    classes=_base_.classes,
    map_head=dict(aux_heads=_base_.model.map_head.aux_heads[:2]))  # no depth
