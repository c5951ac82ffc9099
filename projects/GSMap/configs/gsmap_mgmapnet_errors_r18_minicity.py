# Gaussians on MGMapNet's decoder, as gsmap_mgmapnet_r18_minicity.py, that learn the points' errors, too; scores are
# divided by them.
_base_ = '../../../configs/mgmapnet/mgmapnet_r18_minicity.py'

model = dict(
    map_head=dict(
        type='GSMapHead',
        coder=dict(unfold_classes=[0, 2], sigma_power=1.0),
        reference=dict(type='ErrorReference'),
        losses=[
            *_base_.model.map_head.losses,
            dict(type='SamplingLocationLoss', loss_weight=5.0),
            dict(type='InstanceMaskLoss', embed_dims=128),
            dict(type='GaussianNLLLoss'),
        ]))
