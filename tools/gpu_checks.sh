#!/usr/bin/env bash
# Every check that wants a GPU, in under 40 minutes on one: tools/gpu_checks.sh [WORK_FOLDER]. What it measures is appended to
# WORK_FOLDER/results.md with date and device. A part that fails is named, and the others still run.
#   PYTHON=.venv/bin/python   the interpreter        RESULTS=FILE   where to append instead
#   REDUCED=1                 each part at its smallest, on the CPU: whether the script works, not how fast anything is
set -uo pipefail
cd "$(dirname "$0")/.."
work=$(realpath -m "${1:-work_dirs/gpu_checks}")
python=${PYTHON:-.venv/bin/python}
results=$(realpath -m "${RESULTS:-$work/results.md}")
mkdir -p "$work"
gsmap=projects/GSMap/configs
r50=(configs/maptr/maptr_r50_24e.py configs/mapvr/mapvr_r50_24e.py "$gsmap/gsmap_maptr_r50_24e.py" configs/gemap/gemap_simple_r50_24e.py
    configs/maptrv2/maptrv2_r50_24e.py "$gsmap/gsmap_maptrv2_r50_24e.py" configs/mgmapnet/mgmapnet_r50_24e.py)
r18=(maptr_r18_minicity configs/mapvr/mapvr_r18_minicity.py gsmap_r18_minicity)

if [ -n "${REDUCED:-}" ]; then
    name="CPU, reduced: no figure of this block is a measurement"
    at=(--device cpu --repeats 1 --threads 1)
    fps=("${r18[0]}" --size 90 160 "${at[@]}") memory=("${r18[2]}" --size 90 160 --rasters 64x32 "${at[@]}")
    raster=(--instances 2 "${at[@]}") tests=(tests/ops/test_soft_iou.py)
    data=(--scenes 2 --val-scenes 1 --samples-per-scene 2 --image-size 200x112) budget=1 batch=2 compared=("${r18[0]}")
else
    name=$("$python" -c 'import torch; print(torch.cuda.get_device_name())') || { echo "error: no GPU here; REDUCED=1 tries the script without one"; exit 2; }
    at=(--device cuda --threads 8)
    fps=("${r50[@]}" "${at[@]}") memory=("$gsmap/gsmap_maptr_r50_24e.py" --rasters 128x64 200x100 256x128 --batch 4 "${at[@]}")
    raster=("${at[@]}") tests=(tests/ops tests/models)
    data=(--scenes 400 --samples-per-scene 5 --image-size 400x225) budget=6400 batch=4 compared=("${r18[@]}")
fi

failed=()
part() { # part TITLE COMMAND...: run it, and append its output with the command that made it
    local title=$1 start=$SECONDS
    shift
    echo "[${SECONDS} s] $title: $*"
    "$@" >"$work/part.log" 2>&1 || failed+=("$title")
    { printf '\n### %s\n\n```\n%s\n```\n' "$title" "$*"; echo; grep -E '^(\||[0-9]+ (passed|failed)|=+ .*(passed|failed))|error' "$work/part.log"; } >>"$results"
    tee -a "$work/all.log" <"$work/part.log" | tail -n 3
    echo "    $((SECONDS - start)) s"
}

printf '\n## %s, %s, %s\n' "$(date +%F)" "$name" "$("$python" -c 'import torch; print("torch", torch.__version__)')" >>"$results"
part "Tests" "$python" -m pytest -q -p no:cacheprovider "${tests[@]}"
part "Rasterizers" "$python" -m benchmarks raster "${raster[@]}"
part "Frames per second" "$python" -m benchmarks fps "${fps[@]}"
part "Frames per second, mixed precision" "$python" -m benchmarks fps "${fps[@]}" --fp16
part "A training step by raster" "$python" -m benchmarks step "${memory[@]}"
part "MiniCity" "$python" tools/create_data.py minicity --root "$work/minicity" --seed 0 "${data[@]}"
part "Annotations" "$python" tools/create_data.py nuscenes --root "$work/minicity" --dataset minicity
part "Protocol S" "$python" tools/compare.py "${compared[@]}" --seeds 1 --budget "$budget" --batch "$batch" --out "$work/protocol_s" \
    --data-root "$work/minicity"
[ ${#failed[@]} -eq 0 ] || { printf 'failed: %s\n' "${failed[@]}" | tee -a "$results"; exit 1; }
echo "all parts ended well after $SECONDS s: $results"
