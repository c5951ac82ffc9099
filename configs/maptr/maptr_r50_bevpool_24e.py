# MapTR on depth-pooled BEV features on nuScenes, 24 epochs.
_base_ = './maptr_r50_24e.py'

model = dict(
    bev_encoder=dict(
        _delete_=True, type='LSSEncoder', z_range=(-10.0, 10.0), bev_pixel_m=0.3, embed_dims=256,
        depth_range=(1.0, 35.0, 0.5), camera_aware=False))
