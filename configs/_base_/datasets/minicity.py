# MiniCity: generated towns in nuScenes format, six cameras at 0.4 of their size.
# `python tools/create_data.py minicity --root data/minicity` makes the images,
# `python tools/create_data.py nuscenes --root data/minicity` the annotation files.
_base_ = './nuscenes.py'

data_root = 'data/minicity/'
_file_size = (800, 450)  # of the image files, width and height
_load = [dict(type='LoadCameraImages', to_float32=False), dict(type='ScaleImages', scale=0.4)]

train_dataloader = dict(
    num_workers=1,
    dataset=dict(
        data_root=data_root,
        ann_file='gsmap_minicity_train.arrow',
        pipeline=[
            *_load,
            _base_._photometric,
            dict(type='FormatMapTargets', num_points=20),
            dict(type='PackMapInputs'),
        ]))
val_dataloader = dict(
    num_workers=1,
    dataset=dict(
        data_root=data_root,
        ann_file='gsmap_minicity_val.arrow',
        pipeline=[*_load, dict(type='PackMapInputs')]))
test_dataloader = val_dataloader
