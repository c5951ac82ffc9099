# What makes maptr_r50.py small enough to learn MiniCity from scratch on two CPU cores: narrow ResNet-18, features at
# stride 8, 128 channels, BEV cells of 1.2 m, two decoder layers. Scale it here.
_dim = 128  # channels of BEV features and queries
_width = 24  # channels of the first backbone stage; ResNet-18 has 64

_minicity = dict(
    img_augment=None,
    img_backbone=dict(
        depth=18,
        base_channels=_width,
        out_indices=(1, 2, 3),
        frozen_stages=-1,
        norm_eval=False,
        norm_cfg=dict(type='BN', requires_grad=True),
        init_cfg=None),
    img_neck=dict(  # strides 8, 16 and 32, side by side at stride 8
        _delete_=True,
        type='SECONDFPN',
        in_channels=[2 * _width, 4 * _width, 8 * _width],
        out_channels=[48, 48, 32],
        upsample_strides=[1, 2, 4]),
    bev_encoder=dict(
        embed_dims=_dim,
        bev_pixel_m=1.2,
        z_range=(-2.09, -0.09),  # the lowest pillar height is the ground
        uniform_positions=True,
        cross_attn=dict(equal_weights=True),
        layer_cfg=dict(num_heads=4, ffn_dims=2 * _dim, dropout=0.0)),
    map_head=dict(
        query_groups=[dict(num=20)],
        embed_dims=_dim,
        decoder=dict(num_layers=2, layer=dict(num_heads=4, ffn_dims=2 * _dim, dropout=0.0)),
        masks=dict(pixel_m=60 / 128, cost_pixel_m=60 / 64),
        coder=dict(max_num=20)))
