"""Importing this module registers everything that GSMap adds to mmdet3d's registries."""

from mmdet3d.registry import MODELS

import gsmap.datasets.transforms.images
import gsmap.datasets.transforms.map_targets
import gsmap.datasets.transforms.masks
import gsmap.datasets.transforms.packing
import gsmap.datasets.transforms.points
import gsmap.datasets.vectorized_map_dataset
import gsmap.engine.checkpoint_hook
import gsmap.engine.gaussian_health_hook
import gsmap.engine.log_processor
import gsmap.engine.run_log
import gsmap.evaluation.gaussian_metric
import gsmap.evaluation.map_metric
import gsmap.models.bev_encoders.bev_query_encoder
import gsmap.models.bev_encoders.bevformer
import gsmap.models.bev_encoders.gkt
import gsmap.models.bev_encoders.lidar
import gsmap.models.bev_encoders.lss
import gsmap.models.decoders.map_decoder
import gsmap.models.decoders.mgmapnet_decoder
import gsmap.models.detectors.map_detector
import gsmap.models.heads.aux_heads
import gsmap.models.heads.gemap_head
import gsmap.models.heads.gsmap_head
import gsmap.models.heads.map_head
import gsmap.models.heads.mapvr_head
import gsmap.models.heads.mgmapnet_head
import gsmap.models.heads.references
import gsmap.models.layers.grid_mask
import gsmap.models.layers.multi_granularity
import gsmap.models.layers.self_attention
import gsmap.models.layers.vovnet
import gsmap.models.task_modules.match_costs
import gsmap.visualization.map_visualization_hook
import gsmap.visualization.map_visualizer  # noqa: F401
from gsmap.models.losses.dice import RenderedDiceLoss
from gsmap.models.losses.geometry import EuclideanLoss
from gsmap.models.losses.points import (
    DirectionLoss,
    PointsLoss,
    SamplingLocationLoss,
    SelfDirectionLoss,
)
from gsmap.models.losses.raster import MaskOverlapLoss, RasterLoss
from gsmap.models.losses.segmentation import InstanceMaskLoss

LOSSES = (
    DirectionLoss,
    EuclideanLoss,
    InstanceMaskLoss,
    MaskOverlapLoss,
    PointsLoss,
    RasterLoss,
    RenderedDiceLoss,
    SamplingLocationLoss,
    SelfDirectionLoss,
)
# The losses are plain torch modules, usable without OpenMMLab; they enter the registry here.
for loss in LOSSES:
    MODELS.register_module(module=loss)
