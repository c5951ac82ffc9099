# As published for MapTR nano: AdamW 4e-3 for 192 samples per step.
_base_ = './cosine_110e.py'

optim_wrapper = dict(optimizer=dict(lr=4e-3), clip_grad=dict(max_norm=50))
auto_scale_lr = dict(base_batch_size=192)
