# MGMapNet on nuScenes as released: ResNet-50, 110 epochs, 8 x 2 samples per step.
_base_ = './mgmapnet_r50_24e.py'

train_cfg = dict(max_epochs=110, val_interval=5)
