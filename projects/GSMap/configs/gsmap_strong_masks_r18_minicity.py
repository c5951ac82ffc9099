# A small GSMap whose masks weigh as much as MapVR's and are twice as wide: higher figures, but lines that fold
# (docs/benchmarks/gaussians.md, "Why MapVR is ahead").
_base_ = '../../../configs/maptr/maptr_r18_minicity.py'

model = dict(
    map_head=dict(
        type='GSMapHead',
        points_weight=1.0,
        loss_raster=dict(loss_weight=15.0),
        iou_cost=dict(weight=10.0),
        masks=dict(line_width_m=1.5),
        reference=dict(min_scale_m=60 / 128)))
