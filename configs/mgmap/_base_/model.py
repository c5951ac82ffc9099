# What MGMap changes in MapTR (maptr_r50.py), as published: an enhanced neck with four levels, masks that activate the
# queries, a refinement by patches, mask losses (docs/methods/mgmap.md).
_mgmap = dict(
    map_head=dict(
        points_from_instances=True,
        decoder=dict(
            type='MGMapDecoder', num_masks=50, patches=False),  # released: the refinement sees no patch
        losses=[
            dict(type='PointsLoss', loss_weight=5.0),
            dict(type='DirectionLoss', loss_weight=0.005),
            dict(type='QueryMaskLoss', loss_weight=1.0, dice_weight=2.0),
            dict(type='ForegroundLoss', loss_weight=1.0, dice_weight=15.0, pos_weight=4.0),
        ]))
