# MapTR nano as published: ResNet-18 with trained BatchNorm, BEV 80 x 40, 100 instances, two decoder layers of four
# heads. Published with SyncBN; here BatchNorm, so that it runs without GPUs.
_base_ = './maptr_r18.py'

model = dict(
    img_backbone=dict(
        frozen_stages=-1, norm_eval=False, norm_cfg=dict(type='BN', requires_grad=True)),
    bev_encoder=dict(bev_pixel_m=0.75),
    map_head=dict(
        query_groups=[dict(num=100)],
        decoder=dict(num_layers=2, layer=dict(num_heads=4))))
