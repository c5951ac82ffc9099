# The small MapTR of MiniCity for Argoverse 2's cameras.
_base_ = './maptr_r18_minicity.py'

model = dict(
    bev_encoder=dict(z_range=(-0.58, 1.42), num_cams=7))  # the lowest pillar height is the ground
