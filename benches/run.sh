#!/bin/sh
# Runs all benches and writes their figures to out/bench/index.md, beside ratios to
# another checkout's.
#
#   benches/run.sh [--large] [--against FILE]
#
#   --large         also 12.9 M triangles: minutes more, 3 GB
#   --against FILE  out/bench/figures.json of a run in another checkout, or of an
#                   earlier commit, on the same machine and best as idle
#
# Needs critcmp: cargo install critcmp.
set -eu

cd "$(dirname "$0")/.."
PATH=$PATH:${CARGO_HOME:-$HOME/.cargo}/bin
name=$(git describe --always --dirty 2>/dev/null || echo here)
against=
while [ $# -gt 0 ]; do
    case $1 in
    --large) export LASERTRACE_BENCH_LARGE=1 ;;
    --against)
        against=${2:?"--against: expected figures.json of another run"}
        [ -r "$against" ] || { echo "bench: cannot read $against" >&2; exit 74; }
        shift
        ;;
    *) sed -n '2,/^$/s/^# \{0,1\}//p' "$0" >&2; exit 64 ;;
    esac
    shift
done
command -v critcmp >/dev/null || {
    echo "bench: critcmp is needed: run 'cargo install critcmp'" >&2
    exit 69
}

out=out/bench
mkdir -p "$out"
log=$out/log.txt
: >"$log"
for bench in benches/*.rs; do
    bench=$(basename "$bench" .rs)
    echo "bench: $bench" >&2
    # Not piped, which would hide that a bench failed.
    cargo bench --features race --bench "$bench" -- --save-baseline "$name" >>"$log" 2>&1 || {
        tail -n 20 "$log" >&2
        exit 70
    }
done
critcmp --export "$name" >"$out/figures.json.new"
mv "$out/figures.json.new" "$out/figures.json"

{
    echo "# Benches at $name"
    echo
    echo "$(date -u +%Y-%m-%d), $(nproc) threads, load $(cut -d' ' -f1 /proc/loadavg) at the end."
    echo
    if [ -n "$against" ]; then
        echo 'Time a run, with its spread; before it the ratio to the faster of the two.'
    else
        echo 'Time a run, with its spread.'
    fi
    echo
    echo '```'
    critcmp --color never ${against:+"$against"} "$out/figures.json"
    echo '```'
    echo
    echo '## What the benches print themselves'
    echo
    echo '```'
    # Its own words have a bracket, or begin with one of these.
    grep -E '^[a-z0-9][^[]*: .*[0-9]|^\|' "$log" | grep -vE '^(warning|error|note)' || true
    echo '```'
} >"$out/index.md.new"
mv "$out/index.md.new" "$out/index.md"
echo "$out/index.md"
