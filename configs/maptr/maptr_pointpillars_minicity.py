# A small MapTR with LiDAR alone for MiniCity.
_base_ = './maptr_r18_pointpillars_minicity.py'

model = dict(img_augment=None, img_backbone=None, img_neck=None, bev_encoder=None, bev_fuser=None)
