# GeMap with cameras and LiDAR (SECOND) on nuScenes, simple objective, 110 epochs, 3 x 8 samples per step;
# trains on a GPU.
_base_ = ['../maptr/maptr_r50_second_24e.py', './_base_/model.py']
_base_.model.merge(_base_._gemap)

optim_wrapper = dict(optimizer=dict(weight_decay=0.03))
train_dataloader = dict(batch_size=3)
train_cfg = dict(max_epochs=110, val_interval=1)
auto_scale_lr = dict(base_batch_size=24)
