# Real Argoverse 2 roads with rendered pictures (docs/argoverse2.md), a quarter of the real size, a quarter of that again.
# `python tools/create_data.py av2-render --root data/av2 --out data/av2_rendered` makes them,
# `python tools/create_data.py av2 --root data/av2_rendered` the annotation files, each once per split.
_base_ = './av2.py'

data_root = 'data/av2_rendered/'
_file_size = (512, 512)  # of the image files, width and height, with the padding
_load = [dict(type='LoadCameraImages', to_float32=False), dict(type='ScaleImages', scale=0.25)]

train_dataloader = dict(
    batch_size=4,
    num_workers=1,
    dataset=dict(
        data_root=data_root,
        pipeline=[
            *_load,
            _base_._photometric,
            dict(type='FormatMapTargets', num_points=20),
            dict(type='MakeBEVMask', size=(25, 50), thickness_px=1),
            dict(type='PackMapInputs'),
        ]))
val_dataloader = dict(
    num_workers=1,
    dataset=dict(data_root=data_root, pipeline=[*_load, dict(type='PackMapInputs')]))
test_dataloader = val_dataloader
