# StreamMapNet with what the released code does otherwise than meant: its weights need this config.
_base_ = './streammapnet_r50_24e.py'

model = dict(
    bev_encoder=dict(mirrored_self_attn=True),
    temporal=dict(bev=dict(end_points=True)))
train_dataloader = dict(sampler=dict(late_switch=True))
