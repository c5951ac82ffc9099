# GSMap on MapTRv2, Argoverse 2, 6 epochs: centres have a height, Gaussians and masks lie in the plane.
_base_ = '../../../configs/maptrv2/maptrv2_r50_av2_3d_6e.py'

model = dict(map_head=dict(type='GSMapHead'))
