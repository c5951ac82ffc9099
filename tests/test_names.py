"""What is imported from where, and what an import brings with it."""

import importlib
import re
from pathlib import Path

import pytest
from processes import run_python

import gsmap
from gsmap.utils.lazy import lazy_names

REPO = Path(__file__).resolve().parents[1]
NAMES = [
    *("gsmap.BEVGrid", "gsmap.MapElements", "gsmap.MapEvaluator", "gsmap.MapInferencer"),
    *("gsmap.RasterLoss", "gsmap.list_models", "gsmap.load_model", "gsmap.render_gaussians"),
    *("gsmap.OnnxInferencer", "gsmap.export_onnx", "gsmap.from_records", "mapdata.from_records"),
    *("drivemaps.write_geojson", "gsmap.apis.MapInferencer", "gsmap.apis.load_model"),
    *("gsmap.datasets.VectorizedMapDataset", "gsmap.evaluation.ChamferConfig"),
    *("gsmap.evaluation.MapEvaluator", "gsmap.evaluation.RasterConfig", "drivemaps.MapOrigin"),
    *("gsmap.evaluation.Metric", "gsmap.evaluation.SampleValues", "gsmap.evaluation.MetricReport"),
    *("gsmap.models.GSMapHead", "gsmap.models.MapDetector", "gsmap.models.RasterLoss"),
    *("gsmap.ops.render_gaussians", "gsmap.structures.BEVGrid", "gsmap.structures.MapElements"),
    *("gsmap.visualization.MapVisualizer", "gsmap.visualization.MapStyle"),
]
METRIC = """
from gsmap.evaluation import ChamferConfig, MapEvaluator, RasterConfig
from gsmap.structures import MapElements
classes = ("divider",)
evaluator = MapEvaluator(ChamferConfig(classes), RasterConfig(classes))
line = [[[0.0, -20.0], [0.0, 20.0]]]
found, truth = (MapElements.from_polylines(line, [0], scores) for scores in ([0.9], None))
evaluator.update(found, truth)
figures = evaluator.compute()
assert min(figures["chamfer/mAP"], figures["raster/mAP"]) > 0.999
"""


ELSEWHERE = """
import ctypes, os, signal, sys
sys.platform = "{platform}"
for name in ("fcntl", "pwd", "grp", "resource", "termios"):
    sys.modules[name] = None  # importing it is an ImportError
for place, name in (
    (os, "sched_getaffinity"), (os, "register_at_fork"), (signal, "pthread_sigmask"),
    (signal, "SIGHUP"),
):
    delattr(place, name)
load = ctypes.CDLL
def found(name, *arguments, **options):
    if name is None:
        raise {error}
    return load(name, *arguments, **options)
ctypes.CDLL = found
"""
"""What other systems lack, taken away; `ctypes.CDLL(None)` is where Linux has ``prctl``."""


def modules_after(code: str) -> set[str]:
    """Return what is imported once a program has run."""
    done = run_python("-c", f"{code}\nimport sys; print(*sys.modules)")
    assert not done.returncode, done.stderr
    return set(done.stdout.split())


@pytest.mark.parametrize("name", NAMES)
def test_a_name_is_where_users_look_for_it(name):
    package, _, last = name.rpartition(".")
    module = importlib.import_module(package)
    found = getattr(module, last)
    assert found.__name__ == last
    assert last in module.__all__
    assert last in dir(module)
    assert getattr(module, last) is found


def test_a_name_that_is_nowhere_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'gsmap' has no attribute 'MapInferrer'"):
        gsmap.MapInferrer  # noqa: B018
    load, _, names = lazy_names("gsmap.utils", {"Progress": "progress"})
    assert names == ["Progress"]
    assert load("Progress").__module__ == "gsmap.utils.progress"


def test_every_name_of_every_table_exists():
    for room in ("apis", "datasets", "evaluation", "models", "ops", "prior", "structures"):
        module = importlib.import_module(f"gsmap.{room}")
        assert all(getattr(module, name) for name in module.__all__)


def test_the_packages_text_names_modules_and_pages_that_exist():
    modules = re.findall(r"\bgsmap(?:\.\w+)+", gsmap.__doc__)
    assert modules
    for name in modules:
        importlib.import_module(name)
    pages = re.findall(r"\bdocs/\w+\.md", gsmap.__doc__)
    assert pages
    assert all((REPO / page).exists() for page in pages)


def test_importing_the_library_imports_no_other_package():
    assert not {"numpy", "torch", "mmengine", "mmdet3d"} & modules_after(
        "import gsmap, gsmap.models"
    )


def test_the_metric_needs_no_torch():
    assert not {"torch", "mmengine", "matplotlib"} & modules_after(METRIC)


def test_rendering_needs_nothing_of_openmmlab():
    found = modules_after(
        "from gsmap import BEVGrid, render_gaussians; from gsmap.ops import raster_loss"
    )
    assert not {"mmengine", "mmcv", "mmdet", "mmdet3d", "numba", "matplotlib"} & found


def test_the_inferencer_is_imported_without_what_only_a_model_needs():
    slow = {"mmdet3d.structures", "mmdet3d.models", "mmcv.ops", "mmengine.runner", "matplotlib"}
    slow |= {"numba", "av2", "scipy", "shapely", "pandas"}
    assert not slow & modules_after("from gsmap import MapInferencer")


def test_what_is_slow_to_import_waits_for_its_use():
    """scikit-learn, of which mmdet takes names that it only calls, and torch's compiler."""
    assert not {"sklearn", "pandas", "torch._dynamo"} & modules_after("import gsmap.registered")
    code = """
import gsmap.registered, sys
from mmdet.models.dense_heads import paa_head
from mmdet.models.task_modules.tracking import interpolation
assert "sklearn" not in sys.modules
assert paa_head.skm.GaussianMixture(2).n_components == 2
regressor = interpolation.GPR(interpolation.RBF(3.0))
from sklearn.gaussian_process import GaussianProcessRegressor
assert type(regressor) is GaussianProcessRegressor
assert regressor.kernel.length_scale == 3.0
"""
    assert "sklearn.mixture" in modules_after(code)


@pytest.mark.parametrize(
    ("platform", "error"),
    [("darwin", "AttributeError('prctl')"), ("win32", "TypeError('None')")],
)
def test_metrics_run_where_there_is_no_linux(platform, error):
    """Also what scores files; the commands and their workers need Linux."""
    hidden = ELSEWHERE.format(platform=platform, error=error)
    python_itself = "import concurrent.futures.process, multiprocessing.connection, numpy, numba"
    files = "import gsmap.evaluation.core.file_evaluation"
    code = "\n".join([python_itself, hidden, METRIC, files])
    done = run_python("-c", code)
    assert not done.returncode, done.stderr
