# A small MapTRv2 that learns MiniCity from scratch on two CPU cores: the parts of maptrv2_r50.py at the size of
# maptr_r18_minicity.py, with as many further queries as those that predict.
_base_ = './maptr_r18_minicity.py'

_dim = 128
_pc_range = [-15.0, -30.0, -10.0, 15.0, 30.0, 10.0]

model = dict(
    img_backbone=dict(strides=(1, 2, 2, 1), out_indices=(3,)),
    img_neck=dict(in_channels=[192], out_channels=[128], upsample_strides=[1]),
    bev_encoder=dict(
        _delete_=True,
        type='LSSEncoder',
        pc_range=_pc_range,
        bev_size=(50, 25),
        embed_dims=_dim,
        depth_range=(1.0, 35.0, 1.0),
        aspp_channels=48,
        loss_depth_weight=3.0),
    map_head=dict(
        type='MapTRv2Head',
        pc_range=_pc_range,
        num_one2many=30,
        num_repeats=6,
        decoder=dict(layer=dict(type='DecoupledDecoderLayer', num_points=20)),
        bev_seg=dict(weight=1.0, pos_weight=4.0),
        pv_seg=dict(weight=2.0, pos_weight=1.0)))
