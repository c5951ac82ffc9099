# A small GSMap with other weights for lines (dividers, boundaries) than for crossings: strong, wide masks for lines;
# for crossings MapTR's points, and masks that count only as far as they overlap (results/gaussians.md).
_base_ = '../../../configs/maptr/maptr_r18_minicity.py'

model = dict(
    map_head=dict(
        type='GSMapHead',
        points_weight=[2.0, 5.0, 2.0],
        losses=[dict(type='PointsLoss'), dict(type='DirectionLoss', loss_weight=0.05)],
        loss_raster=dict(loss_weight=[15.0, 10.0, 15.0], full_iou=[0.0, 0.15, 0.0]),
        iou_cost=dict(weight=[10.0, 2.0, 10.0]),
        masks=dict(line_width_m=1.5),
        reference=dict(min_scale_m=60 / 128)))
