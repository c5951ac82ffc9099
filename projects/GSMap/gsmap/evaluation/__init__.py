"""Metrics of maps: AP, topology, whole maps, uncertainty, and the comparison of results."""

from gsmap.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "ChamferConfig": "core.chamfer_ap",
        "MapEvaluator": "core.evaluator",
        "MapMetric": "map_metric",
        "Metric": "core.metric",
        "MetricReport": "core.report",
        "MetricSettings": "core.metric",
        "RasterConfig": "core.raster_ap",
        "Sample": "core.metric",
        "SampleValues": "core.metric",
        "format_table": "core.report",
        "register_metric": "core.metric",
    },
)
