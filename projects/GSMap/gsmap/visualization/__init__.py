"""Pictures of maps over cameras and in bird's-eye view.

``MapVisualizer`` and ``MapVisualizationHook`` need OpenMMLab; the other names need no torch.
"""

from gsmap.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "BEVPanel": "bev_view",
        "CameraView": "camera_view",
        "MapStyle": "style",
        "MapVisualizer": "map_visualizer",
        "compose_figure": "figure",
        "figure_to_rgb": "figure",
        "save_figure": "figure",
    },
)
