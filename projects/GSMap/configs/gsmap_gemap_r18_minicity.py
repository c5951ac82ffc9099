# A small model of Gaussians on GeMap's decoder, for MiniCity.
_base_ = '../../../configs/gemap/gemap_r18_minicity.py'

model = dict(map_head=dict(type='GSMapHead'))
