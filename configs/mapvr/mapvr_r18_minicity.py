# A small MapVR for MiniCity, trained from scratch on two CPU cores.
_base_ = '../maptr/maptr_r18_minicity.py'

model = dict(map_head=dict(type='MapVRHead'))
