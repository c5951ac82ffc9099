# A small MapTRv2 that learns MiniCity from scratch on two CPU cores: the parts of maptrv2_r50.py at the size of
# maptr_r18_minicity.py, with as many further queries as those that predict.
_base_ = './maptr_r18_minicity.py'

model = dict(
    img_backbone=dict(strides=(1, 2, 2, 1), out_indices=(3,)),
    img_neck=dict(in_channels=[192], out_channels=[128], upsample_strides=[1]),
    bev_encoder=dict(
        _delete_=True,
        type='LSSEncoder',
        z_range=(-10.0, 10.0),
        bev_pixel_m=1.2,
        embed_dims=128,
        depth_range=(1.0, 35.0, 1.0),
        aspp_channels=48),
    map_head=dict(
        query_groups=[dict(num=20), dict(name='one2many', num=30, repeats=6, weight=1.0)],
        decoder=dict(layer=dict(self_attn=dict(type='DecoupledSelfAttention'))),
        aux_heads=[
            dict(type='BEVMaskHead', loss_weight=1.0, pos_weight=4.0),
            dict(type='PVMaskHead', loss_weight=2.0, pos_weight=1.0),
            dict(type='DepthSupervision', loss_weight=3.0),
        ]))
