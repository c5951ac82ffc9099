# What MapTRv2 has in place of MapTR's parts (maptr_r50.py), as published for nuScenes: depth lifting supervised by
# LiDAR, one-to-many queries, decoupled self-attention, auxiliary masks. Loads upstream's checkpoints (40.30 M
# trainable parameters there, of which 40.23 M are in use).
_maptrv2 = dict(
    bev_encoder=dict(
        _delete_=True,
        type='LSSEncoder',
        z_range=(-10.0, 10.0),
        bev_pixel_m=0.3,
        embed_dims=256,
        depth_range=(1.0, 35.0, 0.5),
        aspp_channels=96),
    map_head=dict(
        query_groups=[
            dict(num=50),
            dict(name='one2many', num=300, repeats=6, weight=1.0),
        ],
        decoder=dict(layer=dict(self_attn=dict(type='DecoupledSelfAttention'))),
        aux_heads=[
            dict(type='BEVMaskHead', loss_weight=1.0, pos_weight=4.0),
            dict(type='PVMaskHead', loss_weight=2.0, pos_weight=1.0),
            dict(type='DepthSupervision', loss_weight=3.0),
        ]))

# Its sizes for MiniCity, after those of minicity.py.
_maptrv2_minicity = dict(
    bev_encoder=dict(
        bev_pixel_m=1.2, embed_dims=128, depth_range=(1.0, 35.0, 1.0), aspp_channels=48),
    map_head=dict(
        query_groups=[  # as many queries per repeat as one to one, as released
            dict(num=20), dict(name='one2many', num=40, repeats=2, weight=1.0)]))
