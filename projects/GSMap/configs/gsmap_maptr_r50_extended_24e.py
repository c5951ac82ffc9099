# GSMap on MapTR, nuScenes, the six classes of MapVR's extended set, 24 epochs.
_base_ = '../../../configs/maptr/maptr_r50_extended_24e.py'

model = dict(
    map_head=dict(
        type='GSMapHead',
        decoder=dict(layer=dict(type='GaussianDecoderLayer')),
        loss_raster=dict(type='RasterLoss', loss_weight=10.0),
        iou_cost=dict(type='IoUCost', weight=2.0)))
