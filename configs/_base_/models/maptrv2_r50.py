# MapTRv2 with ResNet-50, as published for nuScenes: depth lifting supervised by LiDAR, one-to-many queries,
# decoupled self-attention, auxiliary masks. Loads upstream's checkpoints (40.30 M trainable parameters there,
# of which 40.23 M are in use).
_base_ = './maptr_r50.py'

_pc_range = [-15.0, -30.0, -10.0, 15.0, 30.0, 10.0]

model = dict(
    bev_encoder=dict(
        _delete_=True,
        type='LSSEncoder',
        pc_range=_pc_range,
        bev_size=(200, 100),
        embed_dims=256,
        depth_range=(1.0, 35.0, 0.5),
        aspp_channels=96,
        loss_depth_weight=3.0),
    map_head=dict(
        type='MapTRv2Head',
        pc_range=_pc_range,
        num_instances=50,
        num_one2many=300,
        num_repeats=6,
        one2many_weight=1.0,
        decoder=dict(layer=dict(type='DecoupledDecoderLayer', num_points=20)),
        bev_seg=dict(weight=1.0, pos_weight=4.0),
        pv_seg=dict(weight=2.0, pos_weight=1.0)))
