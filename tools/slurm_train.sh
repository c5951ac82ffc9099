#!/usr/bin/env bash
# Train under Slurm: GPUS=16 GPUS_PER_NODE=8 tools/slurm_train.sh PARTITION JOB_NAME CONFIG [train.py options]
set -euo pipefail
[ $# -ge 3 ] || { echo "usage: [GPUS=8 GPUS_PER_NODE=8 CPUS_PER_TASK=5 SRUN_ARGS=...] $0 PARTITION JOB_NAME CONFIG [train.py options]"; exit 2; }
partition=$1 job=$2 config=$3
shift 3
exec "$(dirname "$0")/slurm_run.sh" "$partition" "$job" "$(dirname "$0")/train.py" "$config" --launcher slurm "$@"
