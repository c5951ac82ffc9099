# MapTR with BEVFormer's spatial cross-attention instead of the geometry kernel attention.
_base_ = './maptr_r50.py'

model = dict(
    bev_encoder=dict(
        cross_attn=dict(
            _delete_=True,
            type='SpatialCrossAttention',
            num_heads=8,
            num_points=8,
            num_heights=4)))
