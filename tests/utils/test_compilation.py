"""Kernels have a place, also where nothing but temporary files can be written."""

import logging
import os
from pathlib import Path

import numba
from numba.core import caching

from gsmap.utils.compilation import make_kernel_folder


def test_a_read_only_installation_without_a_home_compiles_for_the_run(monkeypatch, caplog):
    assert make_kernel_folder() is None
    user_provided = caching.UserProvidedCacheLocator
    monkeypatch.setattr(caching.CompileResultCacheImpl, "_locator_classes", [user_provided])
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    with caplog.at_level(logging.WARNING, "gsmap"):
        folder = make_kernel_folder()
    assert "set NUMBA_CACHE_DIR to a folder that stays" in caplog.text
    assert os.environ["NUMBA_CACHE_DIR"] == folder.name
    assert os.stat(folder.name).st_mode & 0o777 == 0o700  # compiled kernels are code

    @numba.njit(cache=True)
    def twice(x):
        return 2 * x

    assert twice(2) == 4
    assert list(Path(folder.name).rglob("*.nbi"))
    folder.cleanup()
