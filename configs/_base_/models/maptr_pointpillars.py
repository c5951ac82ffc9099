# MapTR with LiDAR alone: PointPillars.
_base_ = './maptr_r50_pointpillars.py'

model = dict(
    img_augment=None,
    img_backbone=None,
    img_neck=None,
    bev_encoder=None,
    lidar_encoder=dict(neck=dict(out_channels=[64, 96, 96])),
    bev_fuser=None)
