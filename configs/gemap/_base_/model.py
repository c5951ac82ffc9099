# What GeMap changes in MapTR's head, or in MapTRv2's: loss and self-attention.
_gemap = dict(
    map_head=dict(
        type='GeMapHead',
        decoder=dict(layer=dict(self_attn=dict(type='GeometryDecoupledAttention')))))
