#!/usr/bin/env bash
# Download the packages that tools/gpu_checks.sh needs: tools/gpu_wheels.sh FOLDER [PYTHON_VERSION].
# They are for a GPU machine without network that has torch, Triton, numpy, numba, OpenCV and pytest. Copy the folder to
# this machine, and run WHEELS=FOLDER tools/gpu_checks.sh there.
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
