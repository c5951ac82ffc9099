# GSMap on MapTR, ResNet-50, nuScenes, 110 epochs: 50 instances of 20 Gaussians, rasters of 200 x 100.
_base_ = '../../../configs/maptr/maptr_r50_110e.py'

model = dict(map_head=dict(type='GSMapHead'))
