# GSMap on MapTR, Argoverse 2, 6 epochs: the paper's Table 2.
_base_ = '../../../configs/maptr/maptr_r50_av2_6e.py'

model = dict(
    map_head=dict(
        type='GSMapHead',
        decoder=dict(layer=dict(type='GaussianDecoderLayer')),
        raster_size=(100, 200),
        cost_raster_size=(64, 128),
        loss_raster=dict(type='RasterLoss', loss_weight=10.0),
        iou_cost=dict(type='IoUCost', weight=2.0)))
