# MapTR with BEVFormer's encoder on nuScenes, 24 epochs.
_base_ = './maptr_r50_24e.py'

model = dict(
    bev_encoder=dict(
        cross_attn=dict(
            _delete_=True, type='SpatialCrossAttention', num_heads=8, num_points=8, num_heights=4)))
