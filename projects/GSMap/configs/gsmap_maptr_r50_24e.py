# GSMap on MapTR, ResNet-50, nuScenes, 24 epochs: 50 instances of 20 Gaussians, rasters of 200 x 100.
_base_ = '../../../configs/maptr/maptr_r50_24e.py'

model = dict(map_head=dict(type='GSMapHead'))
