# GSMap over time on MiniCity: BEV features and Gaussians are remembered, one epoch of single frames first. Ablations
# (temporal.queries.covariance): 'points', 'moved', 'fused'; temporal=None and the samplers of the base are without memory.
_base_ = '../../../configs/maptr/maptr_r18_minicity.py'

model = dict(
    map_head=dict(type='GSMapHead'),
    temporal=dict(bev=dict(), queries=dict(type='GaussianMemory', num=7, covariance='fused'), embed_dims=128))
train_dataloader = dict(
    batch_size=2, sampler=dict(_delete_=True, type='StreamTrainSampler', slots=2, single_frame_iters=500))
val_dataloader = dict(sampler=dict(_delete_=True, type='StreamTestSampler'))
test_dataloader = val_dataloader
