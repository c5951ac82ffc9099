# VectorMapNet on nuScenes, ResNet-50, 130 epochs, 8 x 5 samples per step, in the frame of the vehicle, as published.
# The annotation files are made with `--frame ego --x-range -30 30 --y-range -15 15 --crossings parallel
# --classes ped_crossing divider boundary --tag _ego_parallel`.
_base_ = [
    '../_base_/datasets/nuscenes_ego.py', './_base_/model.py',
    './_base_/schedule.py', '../_base_/default_runtime.py',
]

model = dict(grid=_base_.grid, classes=_base_.classes)
_scale = dict(type='ScaleImages', size=(455, 256))
_images = [_base_._load, _scale, dict(type='StretchToPadding')]
_data = dict(crossings='parallel')
_targets = dict(type='FormatPolylineTargets', edge_classes=(2,))
train_dataloader = dict(
    batch_size=5,
    sampler=dict(_delete_=True, type='DefaultSampler', shuffle=True),
    dataset=dict(**_data, ann_file='gsmap_nuscenes_train_ego_parallel.arrow', pipeline=[*_images, _targets, _base_._pack]))
val_dataloader = dict(
    sampler=dict(type='DefaultSampler', shuffle=False),
    dataset=dict(**_data, ann_file='gsmap_nuscenes_val_ego_parallel.arrow', pipeline=[*_images, _base_._pack]))
test_dataloader = val_dataloader
