"""Inference with trained models, and their export. The entry is ``MapInferencer``."""

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
