"""A trained model on recorded samples; ``map_inferencer.MapInferencer`` is the entry."""

from gsmap.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "MapInferencer": "map_inferencer",
        "load_model": "loading",
    },
)
