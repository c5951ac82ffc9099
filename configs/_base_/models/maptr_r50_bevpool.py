# MapTR on BEV features pooled along predicted depth (LSS), without depth supervision and without the camera-aware
# depth net of MapTRv2.
_base_ = './maptr_r50.py'

model = dict(
    bev_encoder=dict(
        _delete_=True,
        type='LSSEncoder',
        pc_range=[-15.0, -30.0, -10.0, 15.0, 30.0, 10.0],
        bev_size=(200, 100),
        embed_dims=256,
        depth_range=(1.0, 35.0, 0.5),
        camera_aware=False,
        loss_depth_weight=0.0))
