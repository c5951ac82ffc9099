# A small GSMap whose masks are compared by a dice loss, in the loss and in matching, for MiniCity.
_base_ = '../../../configs/maptr/maptr_r18_minicity.py'

model = dict(
    map_head=dict(
        type='GSMapHead',
        loss_raster=dict(type='MaskOverlapLoss', kind='dice', loss_weight=15.0),
        iou_cost=dict(type='IoUCost', kind='dice', weight=10.0)))
