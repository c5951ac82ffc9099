# GeMap with its full objective on nuScenes, ResNet-50, 110 epochs, 4 x 8 samples per step.
_base_ = [
    '../_base_/datasets/nuscenes.py', '../_base_/models/maptr_r50.py', '../maptrv2/_base_/model.py',
    './_base_/model.py',
    '../_base_/schedules/cosine.py', '../_base_/default_runtime.py',
]
_base_.model.merge(_base_._maptrv2)
_base_.model.merge(_base_._gemap)

model = dict(
    grid=_base_.grid, classes=_base_.classes,
    img_backbone=dict(frozen_stages=-1),
    map_head=dict(query_groups=[dict(num=50)]))
train_dataloader = dict(dataset=dict(pipeline=_base_._depth_seg))
optim_wrapper = dict(optimizer=dict(weight_decay=0.03))
train_cfg = dict(max_epochs=110, val_interval=1)
