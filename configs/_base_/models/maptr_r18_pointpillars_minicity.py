# The small MapTR of MiniCity with cameras and LiDAR: PointPillars of 0.6 m.
_base_ = './maptr_r18_minicity.py'

_pc_range = [-15.0, -30.0, -2.0, 15.0, 30.0, 2.0]
_voxel_size = [0.6, 0.6, 4.0]

model = dict(
    data_preprocessor=dict(
        voxel=True,
        voxel_layer=dict(
            max_num_points=20,
            point_cloud_range=_pc_range,
            voxel_size=_voxel_size,
            max_voxels=(5000, 5000))),
    lidar_encoder=dict(
        type='LidarEncoder',
        voxel_encoder=dict(
            type='PillarFeatureNet',
            in_channels=5,
            feat_channels=[32],
            voxel_size=_voxel_size,
            point_cloud_range=_pc_range,
            norm_cfg=dict(type='BN1d', eps=1e-3, momentum=0.01),
            legacy=False),
        middle_encoder=dict(type='PointPillarsScatter', in_channels=32, output_shape=[100, 50]),
        backbone=dict(
            type='SECOND', in_channels=32, layer_nums=[3], layer_strides=[2], out_channels=[64]),
        neck=dict(type='SECONDFPN', in_channels=[64], upsample_strides=[1], out_channels=[128]),
        bev_pixel_m=1.2),
    bev_fuser=dict(
        type='ConvFuser', camera_channels=128, lidar_channels=128, out_channels=128))
