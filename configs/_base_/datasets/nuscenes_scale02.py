# nuScenes with images at 0.2 of their size, 24 samples per GPU, for MapTR nano.
_base_ = './nuscenes.py'

_scale = dict(type='ScaleImages', scale=0.2)

train_dataloader = dict(
    batch_size=24,
    dataset=dict(pipeline=[
        dict(type='LoadCameraImages'),
        _base_._photometric,
        _scale,
        dict(type='FormatMapTargets', num_points=20),
        dict(type='PackMapInputs'),
    ]))
val_dataloader = dict(
    dataset=dict(pipeline=[dict(type='LoadCameraImages'), _scale, dict(type='PackMapInputs')]))
test_dataloader = val_dataloader
