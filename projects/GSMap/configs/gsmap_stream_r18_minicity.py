# GSMap over time, from scratch on MiniCity's drives: single frames for half of the iterations, then drives with BEV
# features and Gaussians remembered. Ablations: temporal.queries.covariance 'points', 'moved', 'fused'; temporal.bev=None or
# temporal.queries=None; temporal=None with the samplers of the base is without memory.
_base_ = '../../../configs/maptr/maptr_r18_minicity.py'

model = dict(
    map_head=dict(type='GSMapHead'),
    temporal=dict(
        bev=dict(present_share=0.9),
        queries=dict(type='GaussianMemory', num=7, covariance='moved'),
        embed_dims=128))
train_dataloader = dict(
    batch_size=2, sampler=dict(_delete_=True, type='StreamTrainSampler', slots=2, single_frame_iters=3200))
val_dataloader = dict(sampler=dict(_delete_=True, type='StreamTestSampler'))
test_dataloader = val_dataloader
