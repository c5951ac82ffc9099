# Gaussians on MGMap's decoder, for MiniCity: masks that are wide for lines and move no point of a crossing, sigmas of
# the points' errors (results/gaussians.md).
_base_ = '../../../configs/mgmap/mgmap_r18_minicity.py'

model = dict(
    map_head=dict(
        type='GSMapHead',
        points_weight=[5.0, 10.0, 5.0],
        iou_cost=dict(weight=[5.0, 0.0, 5.0]),
        masks=dict(line_width_m=1.5, held_classes=[1]),
        coder=dict(unfold_classes=[0, 2]),
        reference=dict(type='ErrorReference', min_scale_m=60 / 128),
        losses=[*_base_.model.map_head.losses, dict(type='GaussianNLLLoss')]))
