# GeMap with its simple objective on Argoverse 2, 6 epochs, 4 x 8 samples per step.
_base_ = './gemap_simple_r50_av2_24e.py'

train_cfg = dict(max_epochs=6)
