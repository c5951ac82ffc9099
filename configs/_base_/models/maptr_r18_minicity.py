# A small MapTR that learns MiniCity from scratch on two CPU cores: narrow ResNet-18 at stride 16, 128 channels,
# BEV 50 x 25, two decoder layers. Scale it here.
_base_ = './maptr_r18.py'

_dim = 128  # channels of BEV features and queries
_width = 32  # channels of the first backbone stage; ResNet-18 has 64

model = dict(
    img_augment=None,
    img_backbone=dict(
        base_channels=_width,
        strides=(1, 2, 2, 1),
        frozen_stages=-1,
        norm_eval=False,
        norm_cfg=dict(type='BN', requires_grad=True),
        init_cfg=None),
    img_neck=dict(in_channels=[8 * _width], out_channels=_dim),
    bev_encoder=dict(
        embed_dims=_dim, bev_size=(50, 25), layer_cfg=dict(num_heads=4, ffn_dims=2 * _dim)),
    map_head=dict(
        num_instances=30,
        embed_dims=_dim,
        decoder=dict(num_layers=2, layer=dict(embed_dims=_dim, num_heads=4, ffn_dims=2 * _dim)),
        coder=dict(max_num=30)))
