# A small MGMapNet that learns MiniCity from scratch on two CPU cores: the parts of mgmapnet_r50.py at the size of
# maptrv2_r18_minicity.py, with twice its queries; BEV cells of 1.25 m, as two levels need even sides.
_base_ = './maptrv2_r18_minicity.py'

model = dict(
    bev_encoder=dict(bev_pixel_m=1.25),
    map_head=dict(
        type='MGMapHead',
        query_groups=[dict(num=40), dict(name='one2many', num=60, repeats=6, weight=1.0)],
        decoder=dict(
            _delete_=True,
            type='MGMapNetDecoder',
            num_layers=2,
            num_levels=2,
            layer=dict(num_heads=4, ffn_dims=256, dropout=0.0)),
        masks=dict(pixel_m=0.625),
        aux_heads=[
            dict(type='BEVMaskHead', num_masks=3, loss_weight=3.0, pos_weight=1.0, dice_weight=3.0),
            dict(type='NormedPVMaskHead', num_masks=3, loss_weight=2.0, pos_weight=1.0),
            dict(type='DepthSupervision', loss_weight=3.0),
        ]))
