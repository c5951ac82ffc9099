# MGMap on nuScenes as published: ResNet-50, 30 epochs, 4 x 2 samples per step.
_base_ = [
    '../_base_/datasets/nuscenes.py', '../_base_/models/maptr_r50.py', './_base_/model.py',
    '../_base_/schedules/cosine.py', '../_base_/default_runtime.py',
]
_base_.model.merge(_base_._mgmap)

model = dict(grid=_base_.grid, classes=_base_.classes)
_own_masks = dict(type='MakeInstanceMasks', size=(200, 100), mirrored=True)  # as released
_steps = [_base_._load_bytes, _base_._photometric, _base_._scale, _base_._targets, _own_masks, _base_._pack]
train_dataloader = dict(dataset=dict(pipeline=_steps))
optim_wrapper = dict(optimizer=dict(lr=3e-4))
auto_scale_lr = dict(base_batch_size=8)
train_cfg = dict(max_epochs=30, val_interval=6)
find_unused_parameters = True  # the mask feature serves patches alone
