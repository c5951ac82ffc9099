# A small GSMap whose masks are strong and wide for lines (dividers, boundaries), and move no point of a crossing: its
# points learn as MapTR's, its masks teach sigma and theta alone (results/gaussians.md).
_base_ = '../../../configs/maptr/maptr_r18_minicity.py'

model = dict(
    map_head=dict(
        type='GSMapHead',
        points_weight=[1.0, 5.0, 1.0],
        loss_raster=dict(loss_weight=15.0),
        iou_cost=dict(weight=[10.0, 0.0, 10.0]),
        masks=dict(line_width_m=1.5, held_classes=[1]),
        coder=dict(unfold_classes=[0, 2]),
        reference=dict(min_scale_m=60 / 128)))
