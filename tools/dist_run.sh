#!/usr/bin/env bash
# Run a script under torchrun: tools/dist_run.sh PROCESSES SCRIPT [arguments]. NCCL on GPUs, gloo without.
# Several machines: set NNODES, NODE_RANK, MASTER_ADDR and PORT on each.
set -euo pipefail
processes=$1
shift
python=python
[ -x "$(dirname "$0")/../.venv/bin/python" ] && python="$(dirname "$0")/../.venv/bin/python"
# python -m would take modules of the working folder before the installed ones
torchrun='import sys; sys.path[:] = filter(None, sys.path); import runpy; runpy.run_module("gsmap.engine.torchrun", run_name="__main__", alter_sys=True)'
exec "${PYTHON:-$python}" -c "$torchrun" \
    --nnodes="${NNODES:-1}" --node_rank="${NODE_RANK:-0}" \
    --master_addr="${MASTER_ADDR:-127.0.0.1}" --master_port="${PORT:-29500}" \
    --nproc_per_node="$processes" "$@"
