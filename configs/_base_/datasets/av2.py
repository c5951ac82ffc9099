# Argoverse 2, seven ring cameras at 0.3 of their size (padded to one size first), ground truth of
# 60 x 30 m in the ego frame. `python tools/create_data.py av2 --root data/av2 --split train --rate 2.5hz`, and
# the same for val, make the annotation files: every fourth sweep, as in MapTR's evaluation.
_base_ = './nuscenes.py'

data_root = 'data/av2/'
_file_size = (2048, 2048)  # of the image files, width and height, with the padding
grid = dict(x_range=[-30.0, 30.0], y_range=[-15.0, 15.0])  # metres; travel is along the longer side

_load = [dict(type='LoadCameraImages'), dict(type='ScaleImages', scale=0.3)]
_dataset = dict(
    data_root=data_root,
    grid=grid,
    frame='ego',
    cameras=[
        'ring_front_center', 'ring_front_right', 'ring_front_left', 'ring_rear_right', 'ring_rear_left',
        'ring_side_right', 'ring_side_left'
    ])

train_dataloader = dict(
    batch_size=6,
    dataset=dict(
        **_dataset,
        ann_file='gsmap_av2_train.arrow',
        pipeline=[
            *_load,
            _base_._photometric,
            dict(type='FormatMapTargets', num_points=20),
            dict(type='PackMapInputs'),
        ]))
val_dataloader = dict(
    dataset=dict(
        **_dataset,
        ann_file='gsmap_av2_val.arrow',
        pipeline=[*_load, dict(type='PackMapInputs')]))
test_dataloader = val_dataloader
