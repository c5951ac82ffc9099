"""Importing this module registers everything that GSMap adds to mmdet3d's registries."""

from mmdet3d.registry import MODELS

import gsmap.datasets.transforms.images
import gsmap.datasets.transforms.map_targets
import gsmap.datasets.transforms.masks
import gsmap.datasets.transforms.packing
import gsmap.datasets.transforms.points
import gsmap.datasets.vectorized_map_dataset
import gsmap.detectors.map_detector
import gsmap.engine.checkpoint_io
import gsmap.engine.log_processor
import gsmap.evaluation.map_metric
import gsmap.heads.gsmap_head
import gsmap.heads.gsmap_maptrv2_head
import gsmap.heads.map_head
import gsmap.heads.maptrv2_head
import gsmap.layers.bev_encoders.bev_query_encoder
import gsmap.layers.bev_encoders.bevformer
import gsmap.layers.bev_encoders.gkt
import gsmap.layers.bev_encoders.lidar
import gsmap.layers.bev_encoders.lss
import gsmap.layers.decoders.decoupled_layer
import gsmap.layers.decoders.gaussian_decoupled_layer
import gsmap.layers.decoders.gaussian_layer
import gsmap.layers.decoders.map_decoder
import gsmap.layers.grid_mask
import gsmap.matching.map_assigner
import gsmap.matching.map_coder
import gsmap.matching.match_costs
import gsmap.matching.raster_costs
import gsmap.visualization.map_visualization_hook
import gsmap.visualization.map_visualizer  # noqa: F401
from gsmap.losses.dice import RenderedDiceLoss
from gsmap.losses.raster import RasterLoss

# The losses are plain torch modules, usable without OpenMMLab; they enter the registry here.
MODELS.register_module(module=RasterLoss)
MODELS.register_module(module=RenderedDiceLoss)
