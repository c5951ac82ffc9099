# A small GeMap for MiniCity, trained from scratch on two CPU cores.
_base_ = '../maptr/maptr_r18_minicity.py'

model = dict(
    map_head=dict(
        type='GeMapHead',
        decoder=dict(layer=dict(self_attn=dict(type='GeometryDecoupledAttention')))))
