# Gaussians on MGMapNet's decoder that learn the points' errors, too; scores are divided by them.
_base_ = 'gsmap_mgmapnet_r18_minicity.py'

model = dict(
    map_head=dict(
        coder=dict(sigma_power=1.0),
        reference=dict(type='ErrorReference'),
        losses=[*_base_.model.map_head.losses, dict(type='GaussianNLLLoss')]))
