# StreamMapNet without memory on nuScenes, 30 epochs: the published result on the official split.
_base_ = './streammapnet_r50_24e.py'

model = dict(
    temporal=None,
    map_head=dict(
        loss_cls=dict(loss_weight=4.0),
        match_costs=[
            dict(type='mmdet.FocalLossCost', weight=4.0),
            dict(type='SmoothPointsCost', weight=50.0),
        ]))
train_dataloader = dict(sampler=dict(_delete_=True, type='DefaultSampler', shuffle=True))
train_cfg = dict(max_epochs=30)
