# A small GSMap on MapTRv2 for MiniCity, trained from scratch on two CPU cores with LiDAR depth.
_base_ = '../../../configs/maptrv2/maptrv2_r18_minicity.py'

model = dict(map_head=dict(type='GSMapHead'))
