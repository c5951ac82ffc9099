#!/usr/bin/env bash
# What tools/gpu_checks.sh needs on a GPU machine that has torch, Triton, numpy, numba, OpenCV and pytest but no network:
# tools/gpu_wheels.sh FOLDER [PYTHON_VERSION]. Copy the folder there and name it: WHEELS=FOLDER tools/gpu_checks.sh.
set -euo pipefail
cd "$(dirname "$0")/.."
folder=${1:?usage: tools/gpu_wheels.sh FOLDER [PYTHON_VERSION]}
version=${2:-3.12}
pinned() { grep -E "^$1==" requirements.txt; }
platforms=()
for glibc in 2014 _2_17 _2_27 _2_28; do platforms+=(--platform "manylinux${glibc}_x86_64"); done
"${PYTHON:-.venv/bin/python}" -m pip download --quiet --no-deps --only-binary=:all: --dest "$folder" \
    --python-version "$version" --implementation cp "${platforms[@]}" \
    "$(pinned mmengine)" "$(pinned mmcv-lite)" "$(pinned mmdet)" "$(pinned mmdet3d)" "$(pinned shapely)" \
    "$(pinned simplejpeg)" addict platformdirs pycocotools pyquaternion termcolor terminaltables yapf
echo "$(find "$folder" -name '*.whl' | wc -l) wheels for Python $version in $folder"
