# What MapQR has in place of MapTR's parts (maptr_r50.py), as published for nuScenes: pillar heights that are learned,
# one query per element that is scattered to its points, one-to-many queries, auxiliary masks (docs/methods/mapqr.md).
_mapqr = dict(
    bev_encoder=dict(
        type='HeightQueryEncoder',
        cross_attn=dict(type='HeightKernelAttention', num_heads=8, kernel_size=(2, 4)),
        num_layers=3),
    map_head=dict(
        query_groups=[dict(num=100), dict(name='one2many', num=600, repeats=6, weight=1.0)],
        decoder=dict(type='MapQRDecoder'),
        aux_heads=[
            dict(type='BEVMaskHead', loss_weight=1.0, pos_weight=4.0),
            dict(type='PVMaskHead', loss_weight=2.0, pos_weight=1.0),
        ]))
