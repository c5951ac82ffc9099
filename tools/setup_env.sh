#!/usr/bin/env bash
# Build the Python environment in .venv (or the folder given): `tools/setup_env.sh [VENV]`.
# Safe to run again: what is there is kept, a finished environment is recognised in a second, an interrupted one goes on.
#   PYTHON=python3.11            the interpreter that makes the environment
#   TORCH_INDEX_URL=URL          where torch comes from, for a particular CUDA build (default: pip's own index)
set -euo pipefail
cd "$(dirname "$0")/.."
venv=${1:-.venv}
python=${PYTHON:-python3}
stamp="$venv/.gsmap-$(cat requirements.txt requirements-dev.txt pyproject.toml tools/setup_env.sh | sha256sum | cut -c1-16)"

if [ -f "$stamp" ]; then
    echo "Environment $venv is ready (delete it to build it again). Enter it with: source $venv/bin/activate"
    exit 0
fi

started=$SECONDS
step() { printf '\n[%s] %s  (%d s so far)\n' "$1" "$2" $((SECONDS - started)); }
pip() { "$venv/bin/python" -m pip --disable-pip-version-check --no-input "$@"; }
pinned() { grep -E "^$1==" requirements.txt; }

"$python" - <<'PY'
import sys
if not (3, 10) <= sys.version_info[:2] <= (3, 12):
    sys.exit(f"Python 3.10 to 3.12 is needed, {sys.executable} is {sys.version.split()[0]}: set PYTHON=python3.11")
PY
command -v c++ >/dev/null || { echo "A C++ compiler is needed to build mmcv's ops: install g++ (Debian: apt-get install g++)."; exit 1; }

step 1/6 "virtual environment $venv"
[ -x "$venv/bin/python" ] || "$python" -m venv "$venv"
pip install -q "$(pinned setuptools)" wheel ninja psutil

step 2/6 "$(pinned torch)"
pip install -q ${TORCH_INDEX_URL:+--index-url "$TORCH_INDEX_URL"} "$(pinned torch)"
pip install -q "$(pinned numpy)" "$(pinned setuptools)"

step 3/6 "$(pinned mmcv) with its ops, from source (about 5 minutes on 2 cores the first time; pip keeps the wheel)"
if ! "$venv/bin/python" -c 'import mmcv.ops' 2>/dev/null; then
    # -O2 -g0 builds three times as fast as the default -O3 -g, and the ops run as fast.
    log="$venv/mmcv-build.log"
    CFLAGS="-O2 -g0" CXXFLAGS="-O2 -g0" MMCV_WITH_OPS=1 MAX_JOBS=${MAX_JOBS:-$(nproc)} \
        pip install -v --no-build-isolation --no-deps "$(pinned mmcv)" 2>&1 | tee "$log" |
        awk 'match($0, /\[[0-9]+\/[0-9]+\]/) { split(substr($0, RSTART + 1, RLENGTH - 2), n, "/")
                 if (n[1] % 10 == 0 || n[1] == n[2]) { printf "    compiled %d of %d files\n", n[1], n[2]; fflush() } }' ||
        { echo "mmcv did not build; the end of $log:"; tail -n 30 "$log"; exit 1; }
fi

step 4/6 "OpenMMLab, the devkits and the rest"
pip install -q -r requirements.txt

step 5/6 "tools for tests and linting"
pip install -q -c requirements.txt -r requirements-dev.txt  # what they need must not raise a pin
# A CUDA build of torch brings the Triton that fits it; beside the CPU build any recent one serves the interpreter.
"$venv/bin/python" -c 'import triton' 2>/dev/null || pip install -q triton==3.9.0

step 6/6 "GSMap itself, editable, and a first import"
pip install -q --no-deps --no-build-isolation -e .
pip install -q "$(pinned setuptools)"
"$venv/bin/python" - <<'PY'
import mmcv.ops, mmdet3d, mmengine, torch, gsmap
print(f"torch {torch.__version__}, mmengine {mmengine.__version__}, mmcv {mmcv.__version__}, mmdet3d {mmdet3d.__version__}, gsmap {gsmap.__version__}")
PY
rm -f "$venv"/.gsmap-*
touch "$stamp"
echo "Environment $venv is ready after $((SECONDS - started)) s. Enter it with: source $venv/bin/activate"
