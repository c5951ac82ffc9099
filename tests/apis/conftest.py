"""A model that is built once."""

import pytest
import torch
from inferencer_cases import make_config

from gsmap.apis.map_inferencer import MapInferencer


@pytest.fixture(scope="module")
def inferencer():
    torch.manual_seed(0)
    return MapInferencer(make_config(), None, device="cpu")
