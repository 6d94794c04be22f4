#!/usr/bin/env bash
# A scan in eight shards on two nodes of Slurm, both on this machine: a renderer is killed and then a node, what
# merge names is submitted again, and the bytes are compared with those of an undivided scan.
#
#   tests/slurm.sh PROGRAM     lasertrace, built
#
# Needs root, slurm-wlm and munge (apt-get install slurm-wlm munge). What it starts it stops; it
# writes to a folder of its own alone, but for munge's key where there is none.
set -euo pipefail
cd "$(dirname "$0")/.."
program=$(realpath -- "$1")
scripts=$PWD/examples/slurm
work=$(mktemp -d)
export SLURM_CONF=$work/slurm.conf
host=$(hostname -s)

say() { echo "slurm: $*" >&2; }

stop() {
    scancel --me --quiet 2>/dev/null || true
    for file in "$work"/*.pid; do
        [ ! -s "$file" ] || kill "$(cat "$file")" 2>/dev/null || true
    done
    sleep 1
    for file in "$work"/*.pid; do
        [ ! -s "$file" ] || kill -9 "$(cat "$file")" 2>/dev/null || true
    done
    [ -z "${munge:-}" ] || kill "$munge" 2>/dev/null || true
}
trap 'code=$?; stop; [ $code -ne 0 ] || rm -rf "$work"; [ $code -eq 0 ] || say "what there is: $work"; exit $code' EXIT

# Waits up to so many seconds until a command succeeds.
await() {
    local seconds=$1 what=$2
    shift 2
    for _ in $(seq $((4 * seconds))); do
        if "$@" >/dev/null 2>&1; then return; fi
        sleep 0.25
    done
    say "$what: not after $seconds s"
    exit 1
}

cat >"$SLURM_CONF" <<CONF
ClusterName=lasertrace
SlurmctldHost=$host(127.0.0.1)
SlurmUser=root
AuthInfo=cred_expire=6
CommunicationParameters=NoInAddrAny,NoCtldInAddrAny
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SchedulerParameters=batch_sched_delay=0,sched_interval=2,bf_interval=2
ReturnToService=2
SlurmdTimeout=15
KillWait=5
SlurmctldPort=16817
StateSaveLocation=$work/state
SlurmdSpoolDir=$work/%n
SlurmctldPidFile=$work/slurmctld.pid
SlurmdPidFile=$work/%n.pid
SlurmctldLogFile=$work/slurmctld.log
SlurmdLogFile=$work/%n.log
NodeName=w1 NodeHostname=$host NodeAddr=127.0.0.1 Port=16821 CPUs=2 RealMemory=2000
NodeName=w2 NodeHostname=$host NodeAddr=127.0.0.1 Port=16822 CPUs=2 RealMemory=2000
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP
CONF
mkdir "$work/state" "$work/bin"
ln -s "$program" "$work/bin/lasertrace"
export PATH=$work/bin:$PATH

if ! munge -n >/dev/null 2>&1; then
    [ -s /etc/munge/munge.key ] || { mungekey -c 2>/dev/null || dd if=/dev/urandom of=/etc/munge/munge.key bs=1024 count=1 status=none; }
    chown munge:munge /etc/munge/munge.key
    chmod 400 /etc/munge/munge.key
    install -d -o munge -g munge -m755 /run/munge
    runuser -u munge -- munged
    munge=$(cat /run/munge/munged.pid)
    await 10 munge munge -n
fi
slurmctld
slurmd -N w1
slurmd -N w2
await 30 'two idle nodes' sh -c '[ "$(sinfo -h -o %T%D)" = idle2 ]'

scene=$PWD/scenes/bracket/scene.toml
out=$work/out
say 'undivided'
"$program" --quiet scan "$scene" -o "$work/undivided" >/dev/null
say 'eight shards on two nodes'
cd "$work"
array=$(sbatch --parsable --requeue --array=0-7 --cpus-per-task=1 "$scripts/render.sh" "$scene" "$out" 8)
running() { [ "$(squeue -h -t R -o %i | wc -l)" -ge 4 ] && [ "$(find "$out/shards" -name '*.part' -size +8k | wc -l)" -ge 2 ]; }
await 60 'four shards at work' running
say 'a renderer is killed, and a node'
pkill -KILL -o -f "lasertrace --quiet scan .* --shard" || true
kill -KILL "$(cat "$work/w2.pid")"
pkill -KILL -n -f "lasertrace --quiet scan .* --shard" || true
# The node comes back: what ran on it runs again, or is lost.
sleep 2
rm -f "$work/w2.pid"
slurmd -N w2
ended() { [ -z "$(squeue -h -j "$array" -o %i)" ]; }
await 180 'the end of the array' ended
for attempt in 1 2 3; do
    said=$(sbatch --parsable --wait "$scripts/merge.sh" "$scene" "$out") || true
    log=$work/slurm-$said.out
    missing=$(sed -n 's/.*--array=\([0-9,-]*\).*/\1/p' "$log")
    [ -n "$missing" ] || break
    say "missing after attempt $attempt: $missing"
    sbatch --wait --requeue --array="$missing" --cpus-per-task=1 "$scripts/render.sh" "$scene" "$out" 8 >/dev/null || true
done
cat "$log" >&2
# But for times: the manifest, the report's last table; and the paths in the summary.
differing=$(diff -rq "$work/undivided" "$out" | grep -v -e manifest.json -e report.html -e summary.json -e ': shards$' || true)
report() { sed '/<h2>The run<\/h2>/,$d' "$1/report.html"; }
cmp <(report "$work/undivided") <(report "$out") || differing="$differing report"
summary() { sed "s|$1|OUT|g" "$1/summary.json"; }
cmp <(summary "$work/undivided") <(summary "$out") || differing="$differing summary"
[ -z "$differing" ] || { say "differing: $differing"; exit 1; }
count=$(sed -n 's/^  "frames": \([0-9]*\),/\1/p' "$out/summary.json")
echo "$count frames in 8 shards on two nodes, one renderer and one node killed: the bytes of an undivided scan"
