# A small model of Gaussians on MapQR's decoder, for MiniCity.
_base_ = '../../../configs/mapqr/mapqr_r18_minicity.py'

model = dict(map_head=dict(type='GSMapHead'))
