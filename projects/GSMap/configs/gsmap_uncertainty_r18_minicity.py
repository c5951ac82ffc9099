# The small GSMap with sigmas of the points' errors, learned beside the Gaussians that are rendered.
_base_ = '../../../configs/maptr/maptr_r18_minicity.py'

_losses = [*_base_.model.map_head.losses, dict(type='GaussianNLLLoss')]
model = dict(map_head=dict(type='GSMapHead', reference=dict(type='ErrorReference'), losses=_losses))
