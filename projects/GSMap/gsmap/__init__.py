"""Online vectorized HD-map construction with 2D Gaussians.

Light on purpose: the mathematics in ``structures``, ``ops`` and ``evaluation`` needs nothing of
OpenMMLab. A config registers every model, data set and metric with
``custom_imports = dict(imports=['gsmap.registered'])``.
"""

__version__ = "0.1.0"
