# GeMap with cameras and LiDAR (SECOND) on nuScenes, simple objective, 110 epochs, 3 x 8 samples per step; trains on a GPU.
_base_ = [
    '../_base_/datasets/nuscenes_lidar.py',
    '../_base_/models/maptr_r50_second.py',
    '../_base_/schedules/cosine_110e.py',
    '../_base_/default_runtime.py',
]

model = dict(
    grid=_base_.grid,
    classes=_base_.classes,
    map_head=dict(
        type='GeMapHead',
        decoder=dict(layer=dict(self_attn=dict(type='GeometryDecoupledAttention')))))
optim_wrapper = dict(optimizer=dict(weight_decay=0.03))
train_dataloader = dict(batch_size=3)
auto_scale_lr = dict(base_batch_size=24)
