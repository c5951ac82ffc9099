# A small GSMap for MiniCity, trained from scratch on two CPU cores (`make demo`).
_base_ = '../../../configs/maptr/maptr_r18_minicity.py'

model = dict(
    map_head=dict(
        type='GSMapSegmentationHead',
        decoder=dict(layer=dict(type='GaussianDecoderLayer')),
        raster_size=(128, 64),
        cost_raster_size=(64, 32),
        loss_raster=dict(type='RasterLoss', loss_weight=10.0),
        iou_cost=dict(type='IoUCost', weight=2.0)))
