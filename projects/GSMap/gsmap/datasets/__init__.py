"""Annotation files, data set, transforms and samplers."""

from gsmap.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "AnnotationFile": "annotations.file",
        "VectorizedMapDataset": "vectorized_map_dataset",
        "elements_of_predictions": "elements",
    },
)
