# A small MapTR on real Argoverse 2 roads with rendered pictures (projects/MiniCity), a quarter of the real size and a
# quarter of that again, trained from scratch on two CPU cores; the BEV mask as on MiniCity.
# `python tools/create_data.py av2-render --root data/av2 --out data/av2_rendered` makes the pictures,
# `python tools/create_data.py av2 --root data/av2_rendered` the annotation files, each once per split.
_base_ = [
    '../_base_/datasets/av2.py', '../_base_/models/maptr_r50.py', '../_base_/models/minicity.py',
    '../_base_/schedules/minicity.py', '../_base_/default_runtime.py',
]
_base_.model.merge(_base_._minicity)

data_root = 'data/av2_rendered/'
_own = dict(data_root=data_root, pose_only_signals=False)
_file_size = (512, 512)  # of the image files, width and height, with the padding
_load = [dict(type='LoadCameraImages', to_float32=False), dict(type='ScaleImages', scale=0.25)]
_mask = dict(type='MakeBEVMask', size=(25, 50), thickness_px=1)
_steps = [*_load, _base_._photometric, _base_._targets, _mask, _base_._pack]
train_dataloader = dict(
    batch_size=4, num_workers=1, dataset=dict(**_own, rate_hz=None, pipeline=_steps))  # of any rate
val_dataloader = dict(num_workers=1, dataset=dict(**_own, pipeline=[*_load, _base_._pack]))
test_dataloader = val_dataloader
model = dict(
    grid=_base_.grid, classes=_base_.classes,
    bev_encoder=dict(z_range=(-0.58, 1.42), num_cams=7),  # the lowest pillar height is the ground
    map_head=dict(aux_heads=[dict(type='BEVMaskHead', loss_weight=2.0, pos_weight=4.0)]))
