# MGMapNet on Argoverse 2, 24 epochs, 8 x 2 samples per step; neither epochs nor rate were published.
_base_ = './mgmapnet_r50_av2_6e.py'

train_cfg = dict(max_epochs=24)
