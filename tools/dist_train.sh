#!/usr/bin/env bash
# Train on several processes of one or more machines: tools/dist_train.sh CONFIG GPUS [train.py options]
set -euo pipefail
[ $# -ge 2 ] || { echo "usage: $0 CONFIG GPUS [train.py options]"; exit 2; }
config=$1 gpus=$2
shift 2
exec "$(dirname "$0")/dist_run.sh" "$gpus" "$(dirname "$0")/train.py" "$config" --launcher pytorch "$@"
