# A small model of Gaussians on GeMap's decoder, for MiniCity.
_base_ = ['../../../configs/maptr/maptr_r18_minicity.py', '../../../configs/gemap/_base_/model.py']
_base_.model.merge(_base_._gemap)
model = dict(map_head=dict(type='GSMapHead'))
