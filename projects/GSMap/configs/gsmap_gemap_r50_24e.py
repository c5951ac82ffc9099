# Gaussians on GeMap's decoder, ResNet-50, nuScenes, 24 epochs.
_base_ = '../../../configs/gemap/gemap_simple_r50_24e.py'

model = dict(map_head=dict(type='GSMapHead'))
