#!/bin/sh
# Tries input and faults of each kind of issue 44 with the tests that hold them, and writes docs/robustness.md. The tests print
# "tried N …". Fails if one fails.
#
#   tests/robustness.sh [PROGRAM]    PROGRAM: for the comparison of instruction sets [target/debug/lasertrace]
set -eu

program=${1:-${CARGO_TARGET_DIR:-target}/debug/lasertrace}
cd "$(dirname "$0")/.."
export CARGO_TERM_COLOR=never LC_ALL=C
page=docs/robustness.md out=out/verify/robustness
mkdir -p "$out"
rows=$out/rows.md
: >"$rows"
failed=0

# In the build of `make test`: kind, inputs before and their result, goal, group and module of the tests, and filters of their names
tests() {
    kind=$1 before=$2 goal=$3 group=$4 file=$5
    shift 5
    log=$out/$file.txt
    echo "robustness.sh: $file" >&2
    if cargo test -p lasertrace -p lasertrace-c --features lasertrace/service,lasertrace/race --test "$group" -- --nocapture "$@" \
        >"$log" 2>&1; then
        result=$goal
    else
        result="FAILED: $(grep -c '^test .* FAILED$' "$log") tests"
        failed=1
    fi
    # "stl: 20000 mutations, …" and "tried 8 kills"; where a test prints none, it is one input.
    tried=$(sed -nE 's/^(test .* \.\.\. )?(tried|[a-z]+:) ([0-9]+) .*/\3/p' "$log" | awk '{ n += $1 } END { print n + 0 }')
    passed=$(grep -cE '(^|[^a-z])ok$' "$log" || true)
    [ "$tried" -gt 0 ] || tried=$passed
    echo "| $kind | $before | $tried | $result | \`tests/$group/$file\` |" >>"$rows"
}

tests 'mutated files, in process and through the command line' '14.7 million and 20 300: no panic' '0 panics' geometry limits_mutated limits_mutated::
export LASERTRACE_LONG_TESTS=1
tests 'hostile sensors' '3 panics; minutes without progress; σ = 0 and infinite repeatability' \
    '0 panics, hangs and numbers that are not finite' program hostile_sensors hostile_sensors::
tests 'hostile files and limits of the machine' '3 panics or hangs' '0 panics and hangs' program hostile_input hostile_input::
tests 'kills of scans' '157: .part files stay' '0 files lost, different or partial' program interruption interruption::
tests 'kills and damage before a resumed scan' 'with the row above' '0 bytes of difference' program resume resume::
tests 'kills and damage of shards' 'with the row above' '0 bytes of difference' program shards shards::
tests 'folders with files of others' 'files deleted and overwritten' '0 files of others touched' program output_folder output_folder::
tests 'live view: clients that go, drafts of minutes' '70 s without an answer' '0 requests held up' program view view::
tests 'service: silent clients, kills, full disks, hostile jobs' \
    'no answer of healthz with 256 silent clients; a full disk cannot be cleared' '0 jobs lost, 0 requests held up' service faults \
    attacks:: faults::

kind='frames with every set of vector instructions'
before='60 of 60 frames differ without AVX'
if [ -x "$program" ] && command -v cc >/dev/null && grep -q '^flags' /proc/cpuinfo 2>/dev/null; then
    if tests/instruction_sets.sh "$program" "$out/instructions" small >"$out/instructions.txt" 2>&1; then
        result='0 bytes of difference'
    else
        result=FAILED
        failed=1
    fi
    figure=$(tail -n 1 "$out/instructions.txt")
    echo "| $kind | $before | $figure | $result | \`tests/instruction_sets.sh\` |" >>"$rows"
else
    echo "| $kind | $before | – | skipped: needs $program, cc and an x86-64 machine with Linux | \`tests/instruction_sets.sh\` |" >>"$rows"
fi

{
    echo '# Robustness'
    echo
    echo "Written by \`tests/robustness.sh\`, which \`make verify\` runs, on $(date -u +%Y-%m-%d) at commit $(git rev-parse --short=12 HEAD 2>/dev/null || echo unknown)."
    echo
    echo 'Inputs are drawn from fixed seeds. A run that takes longer than 60 s without progress counts as a hang. The column on 0.2.0 quotes'
    echo 'independent tests of that version (issue 44).'
    echo
    echo '| kind | 0.2.0: inputs and result | inputs tried | result | by |'
    echo '|---|---|---|---|---|'
    cat "$rows"
} >"$page.new"
mv "$page.new" "$page"
echo "$(wc -l <"$rows") kinds of input, $(grep -c FAILED "$rows" || true) failed"
exit $failed
