#!/bin/sh
# One task of an array renders one shard; see merge.sh for the whole.
#
#   sbatch --array=0-7 --requeue examples/slurm/render.sh SCENE OUT [N]
#
# SCENE and OUT are on a file system that all nodes see. N, the number of shards, is that of the
# array unless it is said, as it has to be when some of the array are run again.
#SBATCH --cpus-per-task=2
#SBATCH --open-mode=append
set -eu
scene=$1 out=$2 shards=${3:-$SLURM_ARRAY_TASK_COUNT}
code=0
lasertrace --quiet scan "$scene" -o "$out" --shard "auto/$shards" || code=$?
# 75: the disk or memory was full, or the node is being taken away. Run again, but not for ever.
if [ "$code" -eq 75 ] && [ "${SLURM_RESTART_COUNT:-0}" -lt 3 ]; then
    scontrol requeue "${SLURM_ARRAY_JOB_ID}_$SLURM_ARRAY_TASK_ID"
fi
exit "$code"
