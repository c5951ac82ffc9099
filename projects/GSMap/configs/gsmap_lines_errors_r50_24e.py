# GSMap with strong masks for lines and scores divided by sigma, on MapTR, ResNet-50, nuScenes, 24 epochs.
_base_ = ['../../../configs/maptr/maptr_r50_24e.py', '../../../configs/_base_/models/gsmap_lines_errors.py']
_base_.model.merge(_base_._gsmap_lines_errors)
