# GSMap over time, learnt from a trained GSMap: memory starts as a mean of present and past, and drives come from the
# first iteration on. Elements that are seen again are updated in tests. Ablations as of gsmap_stream_r18_minicity.py, and
# temporal.elements=None.
_base_ = '../../../configs/maptr/maptr_r18_minicity.py'

load_from = 'gsmap_r18_minicity'
model = dict(
    map_head=dict(type='GSMapHead'),
    temporal=dict(
        bev=dict(present_share=0.9),
        queries=dict(type='GaussianMemory', num=7, covariance='moved'),
        elements=dict(),
        embed_dims=128))
optim_wrapper = dict(optimizer=dict(lr=3e-4))
train_dataloader = dict(
    batch_size=2, sampler=dict(_delete_=True, type='StreamTrainSampler', slots=2))
val_dataloader = dict(sampler=dict(_delete_=True, type='StreamTestSampler'))
test_dataloader = val_dataloader
