"""Map priors: cells, Gaussians or elements at places that a vehicle has passed before."""

from gsmap.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "ElementPrior": "element_prior",
        "ElementRule": "element_rule",
        "GaussianPrior": "gaussian_prior",
        "GaussianRule": "gaussian_rule",
        "HitMissCounts": "rules",
        "KeepMaximum": "rules",
        "LastSeen": "rules",
        "MapPrior": "map_prior",
        "PriorSettings": "settings",
        "open_prior": "opening",
    },
)
