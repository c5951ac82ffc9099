# LiDAR beside the cameras of maptr_r50.py as in MapTR's fusion config: SECOND's sparse encoder on voxels of
# 0.1 x 0.1 x 0.2 m, fused by one convolution. It trains on a GPU; with the package spconv it tests on a CPU too.
_second = dict(
    data_preprocessor=dict(
        voxel=True,
        voxel_layer=dict(
            max_num_points=10,
            point_cloud_range=[-15.0, -30.0, -5.0, 15.0, 30.0, 3.0],
            voxel_size=[0.1, 0.1, 0.2],
            max_voxels=(90000, 120000))),
    lidar_encoder=dict(
        type='LidarEncoder',
        voxel_encoder=dict(type='HardSimpleVFE', num_features=5),
        middle_encoder=dict(
            type='SparseEncoder',
            in_channels=5,
            sparse_shape=[41, 600, 300],
            output_channels=128,
            order=('conv', 'norm', 'act'),
            encoder_channels=((16, 16, 32), (32, 32, 64), (64, 64, 128), (128, 128)),
            encoder_paddings=([0, 0, 1], [0, 0, 1], [0, 0, [1, 1, 0]], [0, 0]),
            block_type='basicblock'),
        bev_pixel_m=0.3),
    bev_fuser=dict(
        type='ConvFuser', camera_channels=256, lidar_channels=256, out_channels=256))
