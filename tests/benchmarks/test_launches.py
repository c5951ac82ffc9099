"""The pretended GPU's cases, in a process of their own.

Gradients there start threads of torch, after which a process cannot fork trainings, as other tests
do.
"""

from pathlib import Path

import pytest
from processes import run_python

from benchmarks.launches import PARTS
from benchmarks.pretended_gpu import available
from gsmap.models.base.decoder import MapDecoder
from gsmap.models.base.head import MapHead
from gsmap.models.base.matching import MapAssigner
from gsmap.models.data_preprocessor import MapDataPreprocessor
from gsmap.models.detector import MapDetector
from gsmap.models.encoders.camera_encoder import CameraEncoder
from gsmap.models.encoders.lidar import LidarEncoder
from gsmap.models.streams.memory import StreamMemory

CASES = Path(__file__).with_name("launches_cases.py")


@pytest.mark.skipif(not available(), reason="torch has no backends in Python")
@pytest.mark.timeout(1800)
def test_the_pretended_gpu_counts_and_every_config_runs_on_it():
    done = run_python("-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-n", "0", str(CASES))
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-2000:]
    assert " passed" in done.stdout


def test_each_part_is_a_method_of_its_owner():
    """A method that no longer exists would not be counted."""
    owners = {
        "": MapDetector,
        "data_preprocessor": MapDataPreprocessor,
        "bev_encoder": CameraEncoder,
        "lidar_encoder": LidarEncoder,
        "map_head": MapHead,
        "map_head.decoder": MapDecoder,
        "map_head.assigner": MapAssigner,
        "temporal": StreamMemory,
    }
    missing = [part for part in PARTS if not hasattr(owners[part[0]], part[1])]
    assert missing == []
