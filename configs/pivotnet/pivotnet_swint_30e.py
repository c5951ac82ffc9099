# PivotNet on nuScenes, Swin-T, 30 epochs, as published.
_base_ = './pivotnet_r50_30e.py'

model = _base_._swin_t
