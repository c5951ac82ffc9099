# MapVR on MapTR, ResNet-50, nuScenes, 24 epochs, 8 x 8 samples per step: the paper's Tables 1 and 5. The release has 8
# samples per GPU here and 4 for 110 epochs, with the same learning rate.
_base_ = '../maptr/maptr_r50_24e.py'

model = dict(
    bev_encoder=dict(layer_cfg=dict(dropout=0.0)), map_head=dict(type='MapVRHead'))
train_dataloader = dict(batch_size=8)
auto_scale_lr = dict(base_batch_size=64)
train_cfg = dict(val_interval=6)
