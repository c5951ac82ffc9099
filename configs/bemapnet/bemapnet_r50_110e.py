# BeMapNet on nuScenes, ResNet-50, 110 epochs.
_base_ = './bemapnet_r50_30e.py'

param_scheduler = [dict(type='MultiStepLR', by_epoch=True, milestones=[77, 99], gamma=1 / 3)]
train_cfg = dict(max_epochs=110)
