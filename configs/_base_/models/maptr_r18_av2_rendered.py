# The small MapTR of MiniCity for Argoverse 2's cameras and range.
_base_ = './maptr_r18_minicity.py'

_pc_range = [-30.0, -15.0, -2.0, 30.0, 15.0, 2.0]

model = dict(
    bev_encoder=dict(
        pc_range=[-30.0, -15.0, -0.58, 30.0, 15.0, 1.42],  # the lowest pillar height is the ground
        bev_size=(25, 50),
        num_cams=7),
    map_head=dict(
        pc_range=_pc_range, coder=dict(post_center_range=[-35.0, -20.0, 35.0, 20.0])))
