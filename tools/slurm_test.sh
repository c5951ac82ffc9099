#!/usr/bin/env bash
# Test under Slurm: GPUS=8 tools/slurm_test.sh PARTITION JOB_NAME CONFIG CHECKPOINT [test.py options]
set -euo pipefail
[ $# -ge 4 ] || { echo "usage: [GPUS=8 GPUS_PER_NODE=8 CPUS_PER_TASK=5 SRUN_ARGS=...] $0 PARTITION JOB_NAME CONFIG CHECKPOINT [test.py options]"; exit 2; }
partition=$1 job=$2 config=$3 checkpoint=$4
shift 4
exec "$(dirname "$0")/slurm_run.sh" "$partition" "$job" "$(dirname "$0")/test.py" "$config" "$checkpoint" \
    --launcher slurm "$@"
