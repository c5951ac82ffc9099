# nuScenes in the frame of the vehicle (x forward, y left), six cameras of 800 x 480, drives in order, for memory
# over frames. `python tools/create_data.py nuscenes --root data/nuscenes --frame ego --tag _ego --x-range -30 30
# --y-range -15 15 --classes ped_crossing divider boundary` makes the annotation files.
data_root = 'data/nuscenes/'
_file_size = (1600, 900)  # of the image files, width and height
# the one place of range and classes: leaves hand them to the model
grid = dict(x_range=[-30.0, 30.0], y_range=[-15.0, 15.0])  # metres; travel is along the longer side
classes = ['ped_crossing', 'divider', 'boundary']

_load = dict(type='LoadCameraImages')
_load_bytes = dict(type='LoadCameraImages', to_float32=False)  # before a step that converts anyway
_scale = dict(type='ScaleImages', size=(800, 480))
_photometric = dict(type='DistortImages', swap_channels=False)  # each camera its own
_targets = dict(type='FormatMapTargets', orders_of='points')
_pack = dict(type='PackMapInputs')

_workers = dict(num_workers='cores', persistent_workers=True)
_dataset = dict(
    type='VectorizedMapDataset', data_root=data_root, classes=classes, grid=grid, frame='ego',
    cameras=[
        'CAM_FRONT', 'CAM_FRONT_RIGHT', 'CAM_FRONT_LEFT', 'CAM_BACK', 'CAM_BACK_LEFT', 'CAM_BACK_RIGHT'
    ])
train_dataloader = dict(
    batch_size=4,
    **_workers,
    sampler=dict(type='StreamTrainSampler', slots=4, single_frame_iters=3480),
    dataset=dict(
        **_dataset,
        ann_file='gsmap_nuscenes_train_ego.arrow',
        split='train',
        pipeline=[_load_bytes, _photometric, _scale, _targets, _pack]))
val_dataloader = dict(
    batch_size=1,
    **_workers,
    sampler=dict(type='StreamTestSampler'),
    dataset=dict(
        **_dataset, ann_file='gsmap_nuscenes_val_ego.arrow', split='val', test_mode=True,
        pipeline=[_load, _scale, _pack]))
test_dataloader = val_dataloader
