# HRMapNet on MapTRv2, nuScenes, as published: ResNet-50, 110 epochs, 4 x 8 samples per step.
_base_ = './hrmapnet_r50_24e.py'

train_cfg = dict(max_epochs=110)
