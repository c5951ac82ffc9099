"""A trained model on recorded samples; ``map_inferencer.MapInferencer`` is the entry."""

from gsmap.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "MapInferencer": "map_inferencer",
        "OnnxInferencer": "onnx_inferencer",
        "export_onnx": "export",
        "load_model": "loading",
    },
)
