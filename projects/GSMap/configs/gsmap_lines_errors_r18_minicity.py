# The small GSMap with strong masks for lines and scores divided by sigma: the best on MapTR's decoder.
_base_ = ['../../../configs/maptr/maptr_r18_minicity.py', '../../../configs/_base_/models/gsmap_lines_errors.py']
_base_.model.merge(_base_._gsmap_lines_errors)
