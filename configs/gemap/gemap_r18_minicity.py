# A small GeMap for MiniCity, trained from scratch on two CPU cores.
_base_ = ['../maptr/maptr_r18_minicity.py', './_base_/model.py']
_base_.model.merge(_base_._gemap)
