# A small GSMap with GeMap's Euclidean loss, on MapTR's decoder, for MiniCity.
_base_ = '../../../configs/maptr/maptr_r18_minicity.py'

model = dict(
    map_head=dict(
        type='GSMapHead',
        losses=[*_base_.model.map_head.losses, dict(type='EuclideanLoss')]))
