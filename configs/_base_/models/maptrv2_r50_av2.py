# MapTRv2 for Argoverse 2, as published: one layer of voxels from -5 to 3 m. The leaves say
# whether points have a height and whether depth is supervised.
_base_ = './maptrv2_r50.py'

model = dict(bev_encoder=dict(z_range=(-5.0, 3.0)))
