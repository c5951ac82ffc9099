# MapTRv2 for Argoverse 2, as published: x forward +-30 m, y left +-15 m, one layer of voxels from -5 to 3 m, no depth
# supervision. Published with three-dimensional points; here they are two-dimensional.
_base_ = './maptrv2_r50.py'

_pc_range = [-30.0, -15.0, -5.0, 30.0, 15.0, 3.0]

model = dict(
    bev_encoder=dict(pc_range=_pc_range, bev_size=(100, 200), loss_depth_weight=0.0),
    map_head=dict(
        pc_range=_pc_range, coder=dict(post_center_range=[-35.0, -20.0, 35.0, 20.0])))
