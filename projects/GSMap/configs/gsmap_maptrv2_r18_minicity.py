# A small GSMap on MapTRv2 for MiniCity, trained from scratch on two CPU cores with LiDAR depth.
_base_ = '../../../configs/maptrv2/maptrv2_r18_minicity.py'

model = dict(
    map_head=dict(
        type='GSMapV2Head',
        decoder=dict(layer=dict(type='GaussianDecoupledLayer')),
        raster_size=(128, 64),
        cost_raster_size=(64, 32),
        loss_raster=dict(type='RasterLoss', loss_weight=10.0),
        iou_cost=dict(type='IoUCost', weight=2.0)))
