# PivotNet on nuScenes, ResNet-50, 110 epochs.
_base_ = './pivotnet_r50_30e.py'

param_scheduler = [dict(type='MultiStepLR', by_epoch=True, milestones=[77, 99], gamma=0.2)]
train_cfg = dict(max_epochs=110)
