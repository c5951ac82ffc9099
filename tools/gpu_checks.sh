#!/usr/bin/env bash
# Run all checks that need a GPU, the most important ones first, in eight minutes: tools/gpu_checks.sh [WORK_FOLDER].
# The results of each part are appended to WORK_FOLDER/results.md, with date and device. If a part fails or takes too
# long, the script prints its name and goes on. The last lines list the options that these checks allow to turn on.
#   PYTHON=.venv/bin/python   interpreter
#   RESULTS=FILE              file to append the results to, instead of WORK_FOLDER/results.md
#   WHEELS=FOLDER             packages to install first, from tools/gpu_wheels.sh
#   IMAGES=FOLDER             six JPEG files, such as a frame of nuScenes: also measures the reading of samples
#   REDUCED=1                 run each part at its smallest size on the CPU, to test this script
set -uo pipefail
cd "$(dirname "$0")/.."
work=$(realpath -m "${1:-work_dirs/gpu_checks}")
python=${PYTHON:-.venv/bin/python}
results=$(realpath -m "${RESULTS:-$work/results.md}")
mkdir -p "$work"
if [ -n "${WHEELS:-}" ]; then
    "$python" -m pip install -q --no-index --no-deps --no-compile --upgrade --target "$work/site" "$WHEELS"/*.whl || exit 2
    export PYTHONPATH="$work/site"
    for folder in "" /projects/GSMap /projects/MapData /projects/DriveMaps /projects/MiniCity; do
        PYTHONPATH="$PYTHONPATH:$PWD$folder"
    done
fi
maptr=configs/maptr/maptr_r50_24e.py
gsmap=projects/GSMap/configs/gsmap_maptr_r50_24e.py

if [ -n "${REDUCED:-}" ]; then
    name="CPU, reduced: no figure of this block is a measurement"
    at=(--device cpu --repeats 1 --threads 1)
    models=(maptr_r18_minicity) fps=("${at[@]}" --size 64 96) step=("${at[@]}" --size 64 96 --rasters 64x32)
    kernels=(--device cpu --reduced --kernels deformable_sample) tests=(tests/ops/test_soft_iou.py) graphs=() workers=()
    export TRITON_INTERPRET=1
else
    name=$("$python" -c 'import torch; print(torch.cuda.get_device_name())') || { echo "error: no GPU here; REDUCED=1 tries the script without one"; exit 2; }
    at=(--device cuda --threads 8)
    models=("$maptr" "$gsmap") fps=("${at[@]}" --repeats 30) step=("${at[@]}" --repeats 8 --batch 4)
    kernels=(--device cuda) graphs=(--cuda-graphs) workers=(--workers 8)
    tests=(tests/ops/test_triton_kernels.py tests/apis/test_fast_frame.py tests/datasets/transforms/test_image_steps.py
        tests/models/test_step_graphs.py tests/models/encoders/test_fused_resnet.py -k "gpu or captured or recorded or accumulated or random")
fi

failed=()
part() { # part TITLE SECONDS COMMAND...: run a command with a time limit, and append it and its output to the results
    local title=$1 limit=${REDUCED:+3600} start=$SECONDS
    limit=${limit:-$2}
    shift 2
    echo "[${SECONDS} s] $title: $*"
    timeout -k 5 "$limit" "$@" >"$work/part.log" 2>&1 || failed+=("$title")
    { printf '\n### %s\n\n```\n%s\n```\n' "$title" "$*"; echo; grep -E '^(\||\{|\}|  "|GSMAP|[0-9]+ (passed|failed)|=+ .*(passed|failed)|FAILED)|error' "$work/part.log"; } >>"$results"
    tee -a "$work/all.log" <"$work/part.log" | tail -n 4
    echo "    $((SECONDS - start)) s"
}

printf '\n## %s, %s, %s\n' "$(date +%F)" "$name" "$("$python" -c 'import torch; print("torch", torch.__version__)')" >>"$results"
part "Kernels" 70 "$python" -m benchmarks kernels "${kernels[@]}"
right=$(sed -n 's/^GSMAP_TRITON_KERNELS=\([^ ]*\).*/\1/p' "$work/part.log" | tail -n 1)
part "Frames per second" 60 "$python" -m benchmarks fps "${models[@]}" "${fps[@]}" ${graphs[0]+"${graphs[@]}"}
[ -n "${REDUCED:-}" ] || export GSMAP_TRITON_KERNELS=$right
part "Frames per second, kernels" 60 "$python" -m benchmarks fps "${models[@]}" "${fps[@]}" ${graphs[0]+"${graphs[@]}"}
part "Frames per second, kernels, half precision" 60 "$python" -m benchmarks fps "${models[@]}" "${fps[@]}" --fp16 ${graphs[0]+"${graphs[@]}"}
part "A training step, kernels" 60 "$python" -m benchmarks step "${models[@]}" "${step[@]}"
part "A training step, kernels, bfloat16" 60 "$python" -m benchmarks step "${models[@]}" "${step[@]}" --cfg-options model.autocast=bfloat16
part "A training step, kernels, bfloat16, replayed" 60 "$python" -m benchmarks step "${models[@]}" "${step[@]}" --cfg-options \
    model.autocast=bfloat16 model.cuda_graphs=True
part "Tests" 90 "$python" -m pytest -q -p no:cacheprovider "${tests[@]}"
[ -n "${REDUCED:-}" ] || part "A training step, kernels, bfloat16, compiled" 150 "$python" -m benchmarks step "${models[@]}" "${step[@]}" --cfg-options \
    model.autocast=bfloat16 model.compiled=reduce-overhead
[ -z "${IMAGES:-}" ] || part "Samples a second" 60 "$python" -m benchmarks data images "$IMAGES" ${workers[0]+"${workers[@]}"}

[ -z "$right" ] || echo "kernels that are right here: GSMAP_TRITON_KERNELS=$right" | tee -a "$results"
if [[ " ${failed[*]-} " != *" Tests "* ]]; then
    [ -n "${REDUCED:-}" ] || echo "captured frames equal launched ones: cuda_graphs=True (--cuda-graphs)" | tee -a "$results"
fi
[ ${#failed[@]} -eq 0 ] || { printf 'failed: %s\n' "${failed[@]}" | tee -a "$results"; exit 1; }
echo "all parts ended well after $SECONDS s: $results"
