# GSMap on MapTR, ResNet-50, nuScenes, 24 epochs: 50 instances of 20 Gaussians, rasters of 200 x 100.
# 8 x 2 samples per step, a reading of the paper (README).
_base_ = '../../../configs/maptr/maptr_r50_24e.py'

model = dict(map_head=dict(type='GSMapHead'))
train_dataloader = dict(batch_size=2)
auto_scale_lr = dict(base_batch_size=16)
