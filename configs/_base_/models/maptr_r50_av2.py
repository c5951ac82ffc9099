# MapTR for Argoverse 2: seven cameras, x forward +-30 m, y left +-15 m.
_base_ = './maptr_r50.py'

_pc_range = [-30.0, -15.0, -2.0, 30.0, 15.0, 2.0]

model = dict(
    bev_encoder=dict(pc_range=_pc_range, bev_size=(100, 200), num_cams=7),
    map_head=dict(
        pc_range=_pc_range, coder=dict(post_center_range=[-35.0, -20.0, 35.0, 20.0])))
