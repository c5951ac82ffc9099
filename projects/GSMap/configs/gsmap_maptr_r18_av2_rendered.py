# A small GSMap on rendered Argoverse 2 logs, trained from scratch on two CPU cores.
_base_ = '../../../configs/maptr/maptr_r18_av2_rendered.py'

model = dict(
    map_head=dict(
        type='GSMapSegmentationHead',
        decoder=dict(layer=dict(type='GaussianDecoderLayer')),
        raster_size=(64, 128),
        cost_raster_size=(32, 64),
        loss_raster=dict(type='RasterLoss', loss_weight=10.0),
        iou_cost=dict(type='IoUCost', weight=2.0)))
