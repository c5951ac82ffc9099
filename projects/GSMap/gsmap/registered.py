"""Importing this module registers everything that GSMap adds to mmdet3d's registries."""

import gsmap.detectors.map_detector  # noqa: F401
import gsmap.heads.map_head  # noqa: F401
import gsmap.layers.bev_encoders.bev_query_encoder  # noqa: F401
import gsmap.layers.bev_encoders.bevformer  # noqa: F401
import gsmap.layers.bev_encoders.gkt  # noqa: F401
import gsmap.layers.decoders.map_decoder  # noqa: F401
import gsmap.layers.grid_mask  # noqa: F401
import gsmap.matching.map_assigner  # noqa: F401
import gsmap.matching.map_coder  # noqa: F401
import gsmap.matching.match_costs  # noqa: F401
