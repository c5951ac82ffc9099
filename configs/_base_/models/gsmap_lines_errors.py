# GSMap with strong masks for lines, points of crossings that weigh more beside them, and sigmas of the points' errors,
# by which scores are divided (results/gaussians.md). Bands are 1.5 m wide for any range.
_gsmap_lines_errors = dict(
    map_head=dict(
        type='GSMapHead',
        match_costs=[
            dict(type='mmdet.FocalLossCost', weight=2.0),
            dict(type='OrderedPointsCost', weight=[1.0, 5.0, 1.0])],
        losses=[
            dict(type='PointsLoss', loss_weight=[1.0, 8.0, 1.0]),
            dict(type='DirectionLoss', loss_weight=0.005),
            dict(type='GaussianNLLLoss')],
        loss_raster=dict(loss_weight=15.0),
        iou_cost=dict(weight=[10.0, 0.0, 10.0]),
        masks=dict(line_width_m=1.5, held_classes=[1]),
        coder=dict(unfold_classes=[0, 2], sigma_power=1.0),
        reference=dict(type='ErrorReference', min_scale_m=60 / 128)))
