# MapTR with LiDAR alone (PointPillars) on nuScenes, 24 epochs.
_base_ = './maptr_r50_pointpillars_24e.py'

model = dict(
    img_augment=None, img_backbone=None, img_neck=None, bev_encoder=None, bev_fuser=None,
    lidar_encoder=dict(neck=dict(out_channels=[64, 96, 96])))
