# GSMap on MapTR, Argoverse 2, 6 epochs: the paper's Table 2.
# 8 x 2 samples per step, a reading of the paper (README).
_base_ = '../../../configs/maptr/maptr_r50_av2_6e.py'

model = dict(map_head=dict(type='GSMapHead'))
train_dataloader = dict(batch_size=2)
auto_scale_lr = dict(base_batch_size=16)
