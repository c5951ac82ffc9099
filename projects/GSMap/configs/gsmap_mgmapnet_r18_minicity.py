# A small model of Gaussians on MGMapNet's decoder, with its losses of samples and instance masks, for MiniCity. Points
# of lines are put in the order of a short way through them.
_base_ = '../../../configs/mgmapnet/mgmapnet_r18_minicity.py'

model = dict(
    map_head=dict(
        type='GSMapHead',
        coder=dict(unfold_classes=[0, 2]),
        losses=[
            *_base_.model.map_head.losses,
            dict(type='SamplingLocationLoss', loss_weight=5.0),
            dict(type='InstanceMaskLoss', embed_dims=128),
        ]))
