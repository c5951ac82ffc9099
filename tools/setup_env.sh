#!/usr/bin/env bash
# Build the Python environment in .venv or in another folder: tools/setup_env.sh [VENV].
# Run it again to continue an interrupted build; installed packages are kept. If the environment is complete, the script
# ends within a second.
#   PYTHON=python3.11     interpreter that creates the environment
#   TORCH=2.8.0           version of torch (default: the installed one, else the one in requirements.txt)
#   TORCH_INDEX_URL=URL   package index for a particular build of torch (default: pip's own index)
#   GSMAP_MMCV_OPS=1      compile mmcv's operators, for CUDA if nvcc is installed; 0 replaces them by mmcv-lite
#   GSMAP_DEV=1           also install the packages of the tests, the linters and the documentation
set -euo pipefail
cd "$(dirname "$0")/.."
venv=${1:-.venv}
python=${PYTHON:-python3}
dev=${GSMAP_DEV:-0}

installed() { "$venv/bin/python" -c "from importlib.metadata import version; print(version('$1'))" 2>/dev/null || true; }
pinned() { grep -E "^$1==" requirements.txt; }

torch=$(installed torch)
compiled=$([ -z "$(installed mmcv)" ] && echo 0 || echo 1)
ops=${GSMAP_MMCV_OPS:-$compiled}
version=$(cat requirements.txt requirements-dev.txt pyproject.toml tools/setup_env.sh | sha256sum | cut -c1-16)
stamp="$venv/.gsmap-$version"
fits() { [ "${TORCH:-$torch}" = "$torch" ] || [ "$TORCH" = "${torch%+*}" ]; }  # 2.8.0 is also 2.8.0+cpu

if [ -f "$stamp" ] && [ "$ops" = "$compiled" ] && fits && { [ "$dev" = 0 ] || [ -f "$stamp-dev" ]; }; then
    echo "Environment $venv is ready (delete it to build it again). Enter it with: source $venv/bin/activate"
    exit 0
fi

started=$SECONDS
step() { printf '\n[%s] %s  (%d s so far)\n' "$1" "$2" $((SECONDS - started)); }
pip() { "$venv/bin/python" -m pip --disable-pip-version-check --no-input "$@"; }
# Without bytecode: Python compiles the modules that it imports, and compiling all of them takes longer than the download.
add() { pip install -q --no-compile "$@"; }

"$python" - <<'PY'
import sys
if not (3, 10) <= sys.version_info[:2] <= (3, 12):
    sys.exit(f"Python 3.10 to 3.12 is needed, {sys.executable} is {sys.version.split()[0]}: set PYTHON=python3.11")
PY
if [ "$ops" = 1 ] && ! command -v c++ >/dev/null; then
    echo "A C++ compiler is needed to build mmcv's operators: install g++ (Debian: apt-get install g++)."
    exit 1
fi

step 1/4 "virtual environment $venv"
[ -x "$venv/bin/python" ] || "$python" -m venv "$venv"
add "pip>=25"  # earlier versions take half a minute to resolve the requirements

[ -z "$torch" ] || fits || torch=""
wanted="torch==${torch:-${TORCH:-$(pinned torch | cut -d= -f3)}}"
step 2/4 "$wanted"
[ -n "$torch" ] || add ${TORCH_INDEX_URL:+--index-url "$TORCH_INDEX_URL"} "$wanted"

step 3/4 "OpenMMLab, the devkits and the rest"
more=()
if [ "$dev" = 1 ]; then
    more=(-r requirements-dev.txt)
    # A CUDA build of torch has installed its Triton. The CPU build has none; a recent one is installed.
    [ -n "$(installed triton)" ] || more+=(triton==3.9.0)
fi
[ "$ops" = 1 ] || [ "$compiled" = 0 ] || pip uninstall -q -y mmcv  # mmcv-lite has the same folder
sed "s/^torch==.*/$wanted/; $([ "$ops" = 0 ] || echo '/^mmcv-lite==/d')" requirements.txt | add -r /dev/stdin "${more[@]}"
add -q --no-deps --no-build-isolation -e .
# Without compiled operators in mmcv, `import gsmap` provides replacements. The .pth file imports it at Python's start.
echo "import gsmap" > "$("$venv/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/gsmap-mmcv.pth"

has_ops() { "$venv/bin/python" -c 'from mmcv import _ext; exit(_ext.__file__.endswith(".py"))' 2>/dev/null; }
if [ "$ops" = 1 ] && ! has_ops; then
    mmcv=$(pinned mmcv-lite | sed s/-lite//)
    step operators "$mmcv from source (about 5 minutes on 2 cores the first time; pip keeps the wheel)"
    add ninja psutil
    # -O2 -g0 builds three times as fast as the default -O3 -g, and the operators are as fast.
    # The operators work with one build of torch only, so each build has its own cache of wheels.
    log="$venv/mmcv-build.log"
    CFLAGS="-O2 -g0" CXXFLAGS="-O2 -g0" MMCV_WITH_OPS=1 MAX_JOBS=${MAX_JOBS:-$(nproc)} \
        pip wheel -v --no-build-isolation --no-deps -w "$venv/wheels" \
        --cache-dir "${XDG_CACHE_HOME:-$HOME/.cache}/gsmap/torch-$(installed torch)" "$mmcv" 2>&1 | tee "$log" |
        awk 'match($0, /\[[0-9]+\/[0-9]+\]/) { split(substr($0, RSTART + 1, RLENGTH - 2), n, "/")
                 if (n[1] % 10 == 0 || n[1] == n[2]) { printf "    compiled %d of %d files\n", n[1], n[2]; fflush() } }' ||
        { echo "mmcv did not build; the end of $log:"; tail -n 30 "$log"; exit 1; }
    pip uninstall -q -y mmcv-lite mmcv 2>/dev/null
    add --no-deps --force-reinstall "$venv"/wheels/mmcv-*.whl
    rm -r "$venv/wheels"
fi

step 4/4 "a first import"
"$venv/bin/python" -W ignore - <<'PY'
import gsmap.registered
import mmcv, mmcv.ops, mmdet3d, mmengine, torch
ops = "without compiled operators" if mmcv._ext.__file__ == gsmap.mmcv_ext.__file__ else "with compiled operators"
print(f"torch {torch.__version__}, mmengine {mmengine.__version__}, mmcv {mmcv.__version__} {ops}, "
      f"mmdet3d {mmdet3d.__version__}, gsmap {gsmap.__version__}")
PY
rm -f "$venv"/.gsmap-*
touch "$stamp"
[ "$dev" = 0 ] || touch "$stamp-dev"
echo "Environment $venv is ready after $((SECONDS - started)) s. Enter it with: source $venv/bin/activate"
