"""Configs in the form of the original repositories, written for the tests."""

from pathlib import Path

from mmengine.config import Config

from mapdata.upstream_configs.reader import read_assignments
from mapdata.upstream_configs.upstream import convert_upstream, merge

REPO = Path(__file__).resolve().parents[1]
# every config there has one; it is not followed
BASE = "_base_ = ['../_base_/default_runtime.py']"
TEMPLATE = """
_base_ = ['../_base_/default_runtime.py']
plugin = True
range_m = {range_m}
norm = dict(mean=[123.675, 116.28, 103.53], std=[58.395, 57.12, 57.375], to_rgb=True)
map_classes = ['divider', 'ped_crossing', 'boundary']
points = 20
width = 256
hidden = width * 2
rows = {rows}
cols = {cols}
depth = {{'depth': [1.0, 35.0, 0.5]}}
masks = dict(use_aux_seg=True, bev_seg=True, pv_seg=True, seg_classes=1, feat_down_sample=32)
model = dict(
    type='{model}',
    use_grid_mask=True,
    video_test_mode=False,
    pretrained=dict(img='torchvision://resnet50'),
    img_backbone=dict(
        type='ResNet', depth=50, num_stages=4, out_indices=(3,), frozen_stages={frozen},
        norm_cfg=dict(type='BN', requires_grad=False), norm_eval=True, style='pytorch'),
    img_neck=dict(
        type='FPN', in_channels=[2048], out_channels=width, start_level=0, num_outs=1,
        add_extra_convs='on_output', relu_before_extra_convs=True),
    pts_bbox_head=dict(
        type='{model}Head',
        bev_h=rows, bev_w=cols, num_query=900, {queries}
        num_pts_per_vec=points, num_pts_per_gt_vec=points, dir_interval=1,
        query_embed_type='instance_pts', transform_method='minmax', gt_shift_pts_pattern='v2',
        num_classes=len(map_classes), in_channels=width, sync_cls_avg_factor=True,
        with_box_refine=True, as_two_stage=False, code_size=2, code_weights=[1.0, 1.0, 1.0, 1.0],
        transformer=dict(
            type='{prefix}PerceptionTransformer', rotate_prev_bev=True, use_shift=True,
            use_can_bus=True, embed_dims=width, {cameras}
            encoder={encoder},
            decoder=dict(
                type='{prefix}Decoder', num_layers=6, return_intermediate=True,
                transformerlayers=dict(
                    {layer},
                    feedforward_channels=hidden, ffn_dropout={dropout}, operation_order={order}))),
        bbox_coder=dict(
            type='{prefix}NMSFreeCoder', post_center_range={limits}, pc_range=range_m, max_num=50,
            voxel_size=[0.15, 0.15, 4], num_classes=len(map_classes)),
        positional_encoding=dict(type='LearnedPositionalEncoding', num_feats=width // 2),
        loss_cls=dict(type='FocalLoss', use_sigmoid=True, gamma=2.0, alpha=0.25, loss_weight=2.0),
        loss_bbox=dict(type='L1Loss', loss_weight=0.0),
        loss_iou=dict(type='GIoULoss', loss_weight=0.0),
        {losses}),
    train_cfg=dict(pts=dict(
        grid_size=[512, 512, 1], voxel_size=[0.15, 0.15, 4], point_cloud_range=range_m,
        out_size_factor=4,
        assigner=dict(
            type='{prefix}Assigner', cls_cost=dict(type='FocalLossCost', weight=2.0),
            reg_cost=dict(type='BBoxL1Cost', weight=0.0, box_format='xywh'),
            iou_cost=dict(type='IoUCost', iou_mode='giou', weight=0.0),
            {costs}, pc_range=range_m))))
train_pipeline = [
    dict(type='LoadMultiViewImageFromFiles', to_float32=True),
    dict(type='PhotoMetricDistortionMultiViewImage'),
    dict(type='NormalizeMultiviewImage', **norm),
    dict(type='RandomScaleImageMultiViewImage', scales=[{scale}]),
    dict(type='PadMultiViewImage', size_divisor=32),
    dict(type='DefaultFormatBundle3D', class_names=map_classes),
    dict(type='CustomCollect3D', keys={keys}),
]
test_pipeline = [
    dict(type='LoadMultiViewImageFromFiles', to_float32=True),
    dict(type='NormalizeMultiviewImage', **norm),
    dict(type='MultiScaleFlipAug3D', img_scale=(1600, 900), pts_scale_ratio=1, flip=False,
         transforms=[train_pipeline[3], train_pipeline[4]]),
]
data_root = '{root}'
shared = dict(
    type='{dataset}', data_root=data_root, bev_size=(rows, cols), pc_range=range_m,
    fixed_ptsnum_per_line=points, padding_value=-10000, map_classes=map_classes)
data = dict(
    samples_per_gpu={batch},
    workers_per_gpu=4,
    train=dict(ann_file=data_root + 'train.pkl', pipeline=train_pipeline, **shared),
    val=dict(ann_file=data_root + 'val.pkl', pipeline=test_pipeline, samples_per_gpu=1, **shared),
    test=dict(ann_file=data_root + 'val.pkl', pipeline=test_pipeline, **shared),
    shuffler_sampler=dict(type='DistributedGroupSampler'))
optimizer = dict(
    type='AdamW', lr=6e-4, paramwise_cfg=dict(custom_keys={{'img_backbone': dict(lr_mult=0.1)}}),
    weight_decay={decay})
optimizer_config = dict(grad_clip=dict(max_norm=35, norm_type=2))
lr_config = dict(
    policy='CosineAnnealing', warmup='linear', warmup_iters=500, warmup_ratio=1.0 / 3,
    min_lr_ratio=1e-3)
total_epochs = {epochs}
evaluation = dict(interval={evaluate}, pipeline=test_pipeline, metric='chamfer')
runner = dict(type='EpochBasedRunner', max_epochs=total_epochs)
checkpoint_config = dict(interval=1)
{more}
"""

KERNEL = """dict(
    type='BEVFormerEncoder', num_layers=1, pc_range=range_m, num_points_in_pillar=4,
    return_intermediate=False,
    transformerlayers=dict(
        type='BEVFormerLayer',
        attn_cfgs=[
            dict(type='TemporalSelfAttention', embed_dims=width, num_levels=1),
            dict(type='GeometrySptialCrossAttention', pc_range=range_m, embed_dims=width,
                 attention=dict(type='GeometryKernelAttention', embed_dims=width, num_heads=4,
                                dilation=1, kernel_size=(3, 5), num_levels=1))],
        feedforward_channels=hidden, ffn_dropout={dropout},
        operation_order=('self_attn', 'norm', 'cross_attn', 'norm', 'ffn', 'norm')))"""
LIFT = """dict(
    type='LSSTransform', in_channels=width, out_channels=width, feat_down_sample=32,
    pc_range=range_m, voxel_size=[0.15, 0.15, 20.0], dbound=depth['depth'], downsample=2,
    loss_depth_weight=3.0, grid_config=depth,
    depthnet_cfg=dict(use_dcn=False, with_cp=False, aspp_mid_channels=96))"""
LAYER = "type='DetrTransformerDecoderLayer', attn_cfgs=[{self_attn}, {cross_attn}]"
ATTENTION = "dict(type='{kind}', embed_dims=width, num_heads=8, dropout={dropout})"
CROSS = "dict(type='CustomMSDeformableAttention', embed_dims=width, num_levels=1)"
LOSSES = (
    "loss_pts=dict(type='PtsL1Loss', loss_weight={pts}), "
    "loss_dir=dict(type='PtsDirCosLoss', loss_weight={dir})"
)
SEGMENTATION = (
    ", aux_seg=masks, loss_seg=dict(type='SimpleLoss', pos_weight=4.0, loss_weight=1.0), "
    "loss_pv_seg=dict(type='SimpleLoss', pos_weight=1.0, loss_weight=2.0)"
)
COST = "pts_cost=dict(type='OrderedPtsL1Cost', weight={pts})"
NUSCENES = {
    "prefix": "MapTR",
    "range_m": "[-15.0, -30.0, -2.0, 15.0, 30.0, 2.0]", "rows": 200, "cols": 100,
    "limits": "[-20, -35, -20, -35, 20, 35, 20, 35]", "root": "data/nuscenes/", "cameras": "",
    "dataset": "CustomNuScenesLocalMapDataset", "scale": 0.5, "batch": 4, "epochs": 24,
    "evaluate": 2,
    "frozen": 1, "decay": 0.01, "dropout": 0.1, "keys": "['img']", "queries": "num_vec=50,",
    "order": "('self_attn', 'norm', 'cross_attn', 'norm', 'ffn', 'norm')", "more": "",
}  # fmt: skip
LIFTED = NUSCENES | {
    "range_m": "[-15.0, -30.0, -10.0, 15.0, 30.0, 10.0]", "encoder": LIFT,
    "keys": "['img', 'gt_depth']", "dataset": "CustomNuScenesOfflineLocalMapDataset",
}  # fmt: skip


def decoder_layer(kind: str, dropout: float = 0.1) -> str:
    """Decoder layer with one self-attention.

    Args:
        kind: Type of the self-attention.
        dropout: Dropout of the self-attention.
    """
    attention = ATTENTION.format(kind=kind, dropout=dropout)
    return LAYER.format(self_attn=attention, cross_attn=CROSS)


def maptr(**settings: object) -> str:
    """MapTR tiny, or a method built on it.

    Args:
        settings: Parts of ``TEMPLATE`` that differ from those of MapTR.
    """
    values = {
        "model": "MapTR",
        "encoder": KERNEL.format(dropout=0.1),
        "layer": decoder_layer("MultiheadAttention"),
        "losses": LOSSES.format(pts=5.0, dir=0.005),
        "costs": COST.format(pts=5.0),
    }
    return TEMPLATE.format(**(NUSCENES | values | settings))


def maptr_av2(range_m: str = "[-30.0, -15.0, -2.0, 30.0, 15.0, 2.0]") -> str:
    """MapTR on Argoverse 2."""
    encoder = KERNEL.format(dropout=0.1).replace("pc_range=range_m, emb", "num_cams=7, emb")
    return maptr(
        range_m=range_m, rows=100, cols=200, root="data/av2/",
        limits="[-35, -20, -35, -20, 35, 20, 35, 20]", dataset="CustomAV2LocalMapDataset",
        cameras="num_cams=7,", scale=0.3, batch=6, epochs=6, encoder=encoder,
    )  # fmt: skip


def converted(text: str, folder: Path) -> tuple[Config, list[str]]:
    """Convert a config of an original repository.

    Args:
        text: Source of the config.
        folder: Folder to write the source to.

    Returns:
        Our config, and the settings without a counterpart.
    """
    source = folder / "theirs.py"
    source.write_text(text)
    conversion = convert_upstream(read_assignments(source))
    return merge(conversion, REPO / "configs"), conversion.unplaced
