# MiniCity with the map drawn in bird's-eye view, for an auxiliary segmentation loss.
_base_ = './minicity.py'

train_dataloader = dict(
    batch_size=2,
    dataset=dict(pipeline=[
        dict(type='LoadCameraImages', to_float32=False),
        dict(type='ScaleImages', scale=0.4),
        dict(type='FormatMapTargets', num_points=20),
        dict(type='MakeBEVMask', size=(50, 25), thickness_px=1),
        dict(type='PackMapInputs'),
    ]))
