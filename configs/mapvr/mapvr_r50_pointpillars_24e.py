# MapVR with cameras and LiDAR (PointPillars) on nuScenes, 24 epochs: the paper's Table 1.
_base_ = '../maptr/maptr_r50_pointpillars_24e.py'

model = dict(
    bev_encoder=dict(layer_cfg=dict(dropout=0.0)), map_head=dict(type='MapVRHead'))
