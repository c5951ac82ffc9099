# GSMap on MapTRv2, nuScenes, with the 50 one-to-many queries of the paper's Table 3.
_base_ = '../../../configs/maptrv2/maptrv2_r50_24e.py'

model = dict(
    map_head=dict(
        type='GSMapV2Head',
        num_one2many=50,
        decoder=dict(layer=dict(type='GaussianDecoupledLayer')),
        raster_size=(200, 100),
        loss_raster=dict(type='RasterLoss', loss_weight=10.0),
        iou_cost=dict(type='IoUCost', weight=2.0)))
