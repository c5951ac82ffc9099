# LiDAR beside the cameras of maptr_r50.py: PointPillars of 0.15 m, fused with the cameras' BEV features by one
# convolution.
_pc_range = [-15.0, -30.0, -2.0, 15.0, 30.0, 2.0]
_voxel_size = [0.15, 0.15, 4.0]

_pointpillars = dict(
    data_preprocessor=dict(
        voxel=True,
        voxel_layer=dict(
            max_num_points=20,
            point_cloud_range=_pc_range,
            voxel_size=_voxel_size,
            max_voxels=(30000, 40000))),
    lidar_encoder=dict(
        type='LidarEncoder',
        voxel_encoder=dict(
            type='PillarFeatureNet',
            in_channels=5,
            feat_channels=[64],
            voxel_size=_voxel_size,
            point_cloud_range=_pc_range,
            norm_cfg=dict(type='BN1d', eps=1e-3, momentum=0.01),
            legacy=False),
        middle_encoder=dict(type='PointPillarsScatter', in_channels=64, output_shape=[400, 200]),
        backbone=dict(
            type='SECOND',
            in_channels=64,
            layer_nums=[3, 5, 5],
            layer_strides=[2, 2, 2],
            out_channels=[64, 128, 256]),
        neck=dict(
            type='SECONDFPN',
            in_channels=[64, 128, 256],
            upsample_strides=[1, 2, 4],
            out_channels=[128, 128, 128]),
        bev_pixel_m=0.3),
    bev_fuser=dict(
        type='ConvFuser', camera_channels=256, lidar_channels=384, out_channels=256))

# Its sizes for MiniCity, after those of minicity.py: pillars of 0.6 m.
_pointpillars_minicity = dict(
    data_preprocessor=dict(
        voxel_layer=dict(voxel_size=[0.6, 0.6, 4.0], max_voxels=(5000, 5000))),
    lidar_encoder=dict(
        voxel_encoder=dict(feat_channels=[32], voxel_size=[0.6, 0.6, 4.0]),
        middle_encoder=dict(in_channels=32, output_shape=[100, 50]),
        backbone=dict(in_channels=32, layer_nums=[3], layer_strides=[2], out_channels=[64]),
        neck=dict(in_channels=[64], upsample_strides=[1], out_channels=[128]),
        bev_pixel_m=1.2),
    bev_fuser=dict(camera_channels=128, lidar_channels=128, out_channels=128))
