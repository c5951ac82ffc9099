# The small MapTR whose points have a Laplace distribution: nothing is rendered, no layer guided.
_base_ = '../../../configs/maptr/maptr_r18_minicity.py'

_losses = [*_base_.model.map_head.losses, dict(type='GaussianNLLLoss', laplace=True, detach_points=False)]
model = dict(
    map_head=dict(
        type='GSMapHead',
        loss_raster=None,
        iou_cost=None,
        decoder=dict(layer=dict(type='MapDecoderLayer')),
        reference=dict(min_scale_m=0.05, activation='exp', max_scale_m=20.0),
        losses=_losses))
