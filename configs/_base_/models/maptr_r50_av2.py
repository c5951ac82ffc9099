# MapTR for Argoverse 2: seven cameras.
_base_ = './maptr_r50.py'

model = dict(bev_encoder=dict(num_cams=7))
