# BeMapNet on nuScenes, Swin-T, 30 epochs, as published but for random mirroring.
_base_ = './bemapnet_r50_30e.py'

model = _base_._swin_t
