#!/bin/sh
# Makes one scan of all shards, or says which to run again:
#
#   A=$(sbatch --parsable --requeue --array=0-7 examples/slurm/render.sh SCENE OUT 8)
#   sbatch --dependency=afterany:$A examples/slurm/merge.sh SCENE OUT
#
# afterany, not afterok: what counts is what lies in OUT. Where shards are missing, lasertrace ends with 65 and the
# last words of its message are what sbatch takes: sbatch --array=1,4-7 examples/slurm/render.sh SCENE OUT 8
#SBATCH --cpus-per-task=2
set -eu
exec lasertrace --quiet merge "$1" -o "$2"
