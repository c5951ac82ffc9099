# A small MapTR that learns MiniCity from scratch on two CPU cores: narrow ResNet-18, features at stride 8, 128 channels,
# BEV 50 x 25, two decoder layers. Scale it here.
_base_ = './maptr_r18.py'

_dim = 128  # channels of BEV features and queries
_width = 24  # channels of the first backbone stage; ResNet-18 has 64

model = dict(
    img_augment=None,
    img_backbone=dict(
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
        bev_size=(50, 25),
        pc_range=[-15.0, -30.0, -2.09, 15.0, 30.0, -0.09],  # the lowest pillar height is the ground
        layer_cfg=dict(num_heads=4, ffn_dims=2 * _dim, dropout=0.0)),
    map_head=dict(
        num_instances=20,
        embed_dims=_dim,
        decoder=dict(
            num_layers=2,
            layer=dict(embed_dims=_dim, num_heads=4, ffn_dims=2 * _dim, dropout=0.0)),
        coder=dict(max_num=20)))
