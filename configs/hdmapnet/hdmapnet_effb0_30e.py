# HDMapNet on nuScenes, EfficientNet-B0, cameras, 30 epochs, 4 samples per step, as published. The annotation files are
# made with `--frame ego --x-range -30 30 --y-range -15 15 --crossings edges --tag _ego_edges`.
_base_ = [
    '../_base_/datasets/nuscenes_ego.py', './_base_/model.py',
    './_base_/schedule.py', '../_base_/default_runtime.py',
]

classes = ['divider', 'ped_crossing', 'boundary']
model = dict(grid=_base_.grid, classes=classes)
_cameras = [  # each has a network of its own
    'CAM_FRONT_LEFT', 'CAM_FRONT', 'CAM_FRONT_RIGHT', 'CAM_BACK_LEFT', 'CAM_BACK', 'CAM_BACK_RIGHT']
_images = [_base_._load_bytes, dict(type='ScaleImages', size=(352, 128), kernel='bicubic')]
_data = dict(classes=classes, cameras=_cameras, crossings='edges')
train_dataloader = dict(
    sampler=dict(_delete_=True, type='DefaultSampler', shuffle=True),
    dataset=dict(
        **_data, ann_file='gsmap_nuscenes_train_ego_edges.arrow', filter_empty_gt=False,
        pipeline=[*_images, dict(type='MakeLineMaps'), _base_._pack]))
val_dataloader = dict(
    sampler=dict(_delete_=True, type='DefaultSampler', shuffle=False),
    dataset=dict(**_data, ann_file='gsmap_nuscenes_val_ego_edges.arrow', pipeline=[*_images, _base_._pack]))
test_dataloader = val_dataloader
