# A small HDMapNet for MiniCity, trained from scratch on two CPU cores, with pixels of 0.3 m.
_base_ = [
    '../_base_/datasets/minicity.py', './_base_/model.py',
    '../_base_/schedules/minicity.py', '../_base_/default_runtime.py',
]

_width = 24
model = dict(
    grid=_base_.grid, classes=_base_.classes,
    img_backbone=dict(
        _delete_=True, type='mmdet.ResNet', depth=18, base_channels=_width, out_indices=(2, 3), norm_eval=False),
    img_neck=dict(in_channels=(4 * _width, 8 * _width)),
    bev_encoder=dict(image_size=(192, 320), bev_pixel_m=0.6),
    map_head=dict(
        pixel_m=0.3, decoder=dict(base_channels=_width),
        vectorizing=dict(min_area_px=30, min_neighbours=15, step_px=5, jump_px=25)))
_scale = dict(type='ScaleImages', size=(320, 192))  # whatever the size of the files
_targets = dict(type='MakeLineMaps', thickness_px=3, gap_px=5)
train_dataloader = dict(batch_size=2, dataset=dict(pipeline=[_base_._load, _scale, _targets, _base_._pack]))
val_dataloader = test_dataloader = dict(dataset=dict(pipeline=[_base_._load, _scale, _base_._pack]))
