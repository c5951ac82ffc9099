# A small GSMap for MiniCity, trained from scratch on two CPU cores (`make demo`).
_base_ = '../../../configs/maptr/maptr_r18_minicity.py'

model = dict(map_head=dict(type='GSMapHead'))
