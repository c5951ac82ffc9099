# MGMapNet for Argoverse 2, whose config was not released: the encoder's voxels are those of MapTRv2 there, no depth.
_base_ = './mgmapnet_r50.py'

model = dict(
    bev_encoder=dict(z_range=(-5.0, 3.0)),
    map_head=dict(aux_heads=_base_.model.map_head.aux_heads[:2]))
