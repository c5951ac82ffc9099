# BeMapNet on nuScenes, Swin-T, 110 epochs, the best published model, but for random mirroring.
_base_ = './bemapnet_r50_30e.py'

model = _base_._swin_t
param_scheduler = [dict(type='MultiStepLR', by_epoch=True, milestones=[77, 99], gamma=1 / 3)]
train_cfg = dict(max_epochs=110)
