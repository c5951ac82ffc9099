# A small model of Gaussians on MGMap's decoder, for MiniCity.
_base_ = '../../../configs/mgmap/mgmap_r18_minicity.py'

model = dict(map_head=dict(type='GSMapHead'))
