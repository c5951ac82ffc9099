# MapTRv2 on Argoverse 2 with points of three coordinates (64.7 mAP published), 6 epochs, 4 x 8 samples per step.
# The annotation files are made with `--dim 3`; configs of two coordinates read them as well.
_base_ = [
    '../_base_/datasets/av2.py', '../_base_/models/maptr_r50.py', './_base_/model.py',
    '../_base_/schedules/cosine.py', '../_base_/default_runtime.py',
]
_base_.model.merge(_base_._maptrv2)

_heights = (-5.0, 3.0)  # metres
model = dict(
    grid=_base_.grid, classes=_base_.classes,
    bev_encoder=dict(z_range=_heights),
    map_head=dict(
        aux_heads=_base_._maptrv2.map_head.aux_heads[:2], reference=dict(coords=3, z_range=_heights)))
train_dataloader = dict(batch_size=4, dataset=dict(dim=3, pipeline=_base_._seg))
val_dataloader = dict(dataset=dict(dim=3))
test_dataloader = val_dataloader
param_scheduler = [dict(_base_.param_scheduler[0], end=200), _base_.param_scheduler[1]]
train_cfg = dict(max_epochs=6, val_interval=1)
