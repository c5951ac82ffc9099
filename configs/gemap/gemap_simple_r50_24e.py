# GeMap with its simple objective on nuScenes, ResNet-50, 24 epochs, 4 x 8 samples per step.
_base_ = '../maptr/maptr_r50_24e.py'

model = dict(
    map_head=dict(
        type='GeMapHead',
        decoder=dict(layer=dict(self_attn=dict(type='GeometryDecoupledAttention')))))
optim_wrapper = dict(optimizer=dict(weight_decay=0.03))
