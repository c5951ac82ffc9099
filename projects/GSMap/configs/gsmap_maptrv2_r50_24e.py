# GSMap on MapTRv2, nuScenes, with the 50 one-to-many queries of the paper's Table 3.
# 8 x 2 samples per step, a reading of the paper (README).
_base_ = '../../../configs/maptrv2/maptrv2_r50_o2m50_24e.py'

model = dict(map_head=dict(type='GSMapHead'))
train_dataloader = dict(batch_size=2)
auto_scale_lr = dict(base_batch_size=16)
