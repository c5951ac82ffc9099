# PivotNet on nuScenes, Swin-T, 110 epochs, the best published model.
_base_ = './pivotnet_swint_30e.py'

param_scheduler = [dict(type='MultiStepLR', by_epoch=True, milestones=[77, 99], gamma=0.2)]
train_cfg = dict(max_epochs=110)
