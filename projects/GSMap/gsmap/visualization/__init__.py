"""Pictures of maps over cameras and in bird's-eye view.

``MapVisualizer`` and ``MapVisualizationHook`` live in modules of their own that need OpenMMLab;
what is imported here needs neither that nor torch.
"""

from gsmap.visualization.bev_view import BEVPanel
from gsmap.visualization.camera_view import CameraView
from gsmap.visualization.figure import compose_figure, figure_to_rgb, save_figure
from gsmap.visualization.frame_view import FRAME_VIEWS, FrameView
from gsmap.visualization.style import MapStyle

__all__ = [
    "FRAME_VIEWS",
    "BEVPanel",
    "CameraView",
    "FrameView",
    "MapStyle",
    "compose_figure",
    "figure_to_rgb",
    "save_figure",
]
