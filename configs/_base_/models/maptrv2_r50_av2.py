# MapTRv2 for Argoverse 2, as published: one layer of voxels from -5 to 3 m. Published with three-dimensional points; here
# they are two-dimensional. Depth supervision is the leaf's affair.
_base_ = './maptrv2_r50.py'

model = dict(bev_encoder=dict(z_range=(-5.0, 3.0)))
