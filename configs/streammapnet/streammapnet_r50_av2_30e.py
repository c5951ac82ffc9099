# StreamMapNet on Argoverse 2, 60 x 30 m, seven cameras of 608 x 608, 30 epochs, 8 x 4 samples per step. The annotation
# files are made with `--rate 2hz --tag _2hz` and `--classes ped_crossing divider boundary`.
_base_ = [
    '../_base_/datasets/av2.py', '../_base_/models/maptr_r50.py', './_base_/model.py',
    '../_base_/schedules/cosine.py', '../_base_/default_runtime.py',
]
_base_.model.merge(_base_._streammapnet)
_base_.optim_wrapper.merge(_base_._optim_wrapper)
classes = ['ped_crossing', 'divider', 'boundary']
model = dict(grid=_base_.grid, classes=classes, bev_encoder=dict(num_cams=7))
_scale = dict(type='ScaleImages', size=(608, 608))
_photometric = dict(type='DistortImages', swap_channels=False)
_train = [_base_._load, _photometric, _scale, dict(_base_._targets, orders_of='points'), _base_._pack]
_test = dict(classes=classes, ann_file='gsmap_av2_val_2hz.arrow', pipeline=[_base_._load, _scale, _base_._pack])
train_dataloader = dict(
    batch_size=4, sampler=dict(_delete_=True, type='StreamTrainSampler', slots=4, single_frame_iters=3750),
    dataset=dict(classes=classes, rate_hz=2.0, ann_file='gsmap_av2_train_2hz.arrow', pipeline=_train))
val_dataloader = dict(sampler=dict(_delete_=True, type='StreamTestSampler'), dataset=_test)
test_dataloader = val_dataloader
param_scheduler = _base_._param_scheduler
sync_bn = 'torch'  # of several ranks
train_cfg = dict(max_epochs=30, val_interval=5)
