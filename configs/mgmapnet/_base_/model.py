# What MGMapNet changes in MapTRv2 (maptrv2.py), as released for nuScenes: one query per element whose points share its
# samples, two BEV levels, masks of classes and of instances (docs/methods/mgmapnet.md).
_mgmapnet = dict(
    map_head=dict(
        type='MGMapHead',
        query_groups=[dict(num=100), dict(name='one2many', num=600, repeats=6, weight=1.0)],
        decoder=dict(
            _delete_=True,
            type='MGMapNetDecoder',
            num_layers=6,
            num_levels=2,
            layer=dict(num_heads=8, ffn_dims=512, dropout=0.1)),
        aux_heads=[
            dict(type='BEVMaskHead', num_masks=3, loss_weight=3.0, pos_weight=1.0, dice_weight=3.0),
            dict(type='NormedPVMaskHead', num_masks=3, loss_weight=2.0, pos_weight=1.0),
            dict(type='DepthSupervision', loss_weight=3.0),
        ]))
