# GeMap with its full objective on Argoverse 2, 24 epochs, 4 x 8 samples per step; as published without depth.
_base_ = ['../maptrv2/maptrv2_r50_av2_6e.py', './_base_/model.py']
_base_.model.merge(_base_._gemap)
model = dict(img_backbone=dict(frozen_stages=-1), map_head=dict(query_groups=[dict(num=50)]))
optim_wrapper = dict(optimizer=dict(weight_decay=0.03))
train_cfg = dict(max_epochs=24)
