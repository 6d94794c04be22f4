#!/bin/sh
# The long checks and those with other programs. Each is skipped, with a word, where its
# tool is absent. Fails if a goal is missed.
#
#   tests/verify.sh        hours; writes docs/verification.md
#   tests/verify.sh small  two minutes after `cargo test`; writes out/verify/small.md
set -eu

cd "$(dirname "$0")/.."
PATH=$PATH:${CARGO_HOME:-$HOME/.cargo}/bin
export CARGO_TERM_COLOR=never LC_ALL=C
# Tests with a short form have their complete extent.
[ "${1:-long}" = small ] || export LASERTRACE_LONG_TESTS=1
out=out/verify
mkdir -p "$out"
# The short form runs the program that the tests built. `cargo run` would build the library once more,
# with the features that dependencies have without the tests.
case ${1:-long} in
small) page=$out/small.md rays=50000 surfaces=0 seconds=3 profile= bench='--profile test' times=2.5 features='--features service,race' program=${CARGO_TARGET_DIR:-target}/debug/lasertrace ;;
long) page=docs/verification.md rays=100000000 surfaces=16 seconds=240 profile=--release bench= times=1.5 features= program='cargo run --release --' ;;
*) sed -n '2,/^set/s/^# \{0,1\}//p' "$0" >&2; exit 64 ;;
esac
rows=$out/rows.md
: >"$rows"
missed=0

# check, figure, goal, whether it is met, command
row() {
    echo "| $1 | $2 | $3 | $4 | \`$5\` |" >>"$rows"
    echo "verify: $1: $2 ($4)" >&2
    [ "$4" != no ] || missed=1
}

skip() {
    row "$1" – "$2" "skipped: $3" "$4"
}

# A check that has no short form: name, goal, name of the log, a sed script that prints the figure, command
long_only() {
    if [ "$page" = "$out/small.md" ]; then
        skip "$1" "$2" 'not in the small form' "$5"
        return
    fi
    # shellcheck disable=SC2086 # a command is words
    try "$3" $5
    row "$1" "$(sed -nE "$4" "$log" | paste -sd ' ')" "$2" "$met" "$5"
}

# Runs a command, with what it prints in $log, and tells whether it succeeded.
try() {
    log=$out/$1.txt
    shift
    echo "verify: $*" >&2
    if "$@" >"$log" 2>&1; then met=yes; else met=no; fi
}

of_plans='of plans that say so, few leave more than 1 % of points beyond (binomial, 0.999); all together less than 1 %'
long_only 'plans on generated scenes keep their tolerance' "$of_plans" plans '/ scenes with a line/p' \
    'cargo test --release --test points accuracy::a_hundred -- --ignored --nocapture'
long_only 'plans on real parts keep their tolerance' "$of_plans" plans-of-parts '/ scenes with a line|NOT TESTED/p' \
    'cargo test --release --test points accuracy::plans_of_real -- --ignored --nocapture'

name='95 % intervals of scenes drawn from a seed'
goal='94 to 96 % of at least 5000 independent columns, and no scene of 40 whose exact binomial interval excludes 95 % (0.001 over all)'
command='cargo test --release --test points forty_scenes -- --ignored --nocapture'
if [ "$page" = "$out/small.md" ]; then
    skip "$name" "$goal" 'not in the small form' "$command"
else
    # shellcheck disable=SC2086
    try intervals $command
    row "$name" "$(sed -n 's/^pooled: //p' "$log")" "$goal" "$met" "$command"
    {
        echo '# Intervals of 95 % in scenes drawn from a seed'
        echo
        echo "Written by \`make verify\` with \`$command\`."
        echo
        echo 'Each scene is a tilted plane under a sensor, both drawn from a seed. Columns are counted that lie a correlation length'
        echo 'apart, in frames that have no speckle in common; without speckle, each frame is from another sensor. The exact interval is'
        echo 'by Clopper and Pearson at a false-alarm rate of 0.001 over all scenes; σ/h is the standard deviation of the line over the'
        echo 'length of a grain.'
        echo
        grep '^|' "$log"
        echo
        sed -n 's/^pooled: \(.*\)/All scenes: \1./p' "$log"
    } >docs/intervals.md.new
    mv docs/intervals.md.new docs/intervals.md
fi

of_fits='94 to 96 % of all intervals of 200 generated sensors contain the truth, no parameter is excluded by its binomial interval (0.001 over all), and misfits are at most 5 %'
long_only 'fits of generated sensors' "$of_fits" fits 's/^pooled: //p' \
    'cargo test --release --test points fit::intervals_of_two -- --ignored --nocapture'
long_only 'wrong models in recordings' 'a filter, saturation and a second line are reported in at least 90 % of 40 cases each' misfits '/ of 40 cases/p' \
    'cargo test --release --test points fit::forty -- --ignored --nocapture'
long_only 'real recordings next to simulations (writes docs/real-profiles.md)' 'the page is written' recordings '/^NOT TESTED/p' \
    'env LASERTRACE_WRITE_PAGES=1 cargo test --release --test points real_recordings::page -- --ignored --nocapture'

# The tables of a log, with an empty line between them
tables() {
    awk '/^\|/ { print; inside = 1; next } inside { print ""; inside = 0 }' "$log"
}

name='mistakes of users and sound scenes'
goal='check warns of each mistake and of none of ten sound scenes'
command='cargo test --features service,race --test program -- --nocapture --test-threads 1 mistakes_of sound_scenes'
if [ "$page" = "$out/small.md" ]; then
    skip "$name" "$goal" 'not in the small form' "$command"
else
    # shellcheck disable=SC2086
    try mistakes $command
    row "$name" "$(grep -c '^| .*| no warning |' "$log") sound scenes without a warning; docs/mistakes.md" "$goal" "$met" "$command"
    {
        echo '# Mistakes of users, and sound scenes'
        echo
        echo "Written by \`make verify\` with \`$command\`."
        echo
        echo 'Each mistake is made in a scene that is drawn from a seed (tests/mistakes). The output is all warnings of `check`.'
        echo 'The fractions are those of the assessment.'
        echo
        tables
    } >docs/mistakes.md.new
    mv docs/mistakes.md.new docs/mistakes.md
fi

name='small files of the kinds that users have'
goal='read, warned of or refused as the README of the files calls right'
command='cargo test --features service,race --test geometry --test points -- --nocapture --test-threads 1 readme_of_the_files image_cases'
# shellcheck disable=SC2086
try mesh-cases $command
if grep -qE 'NOT TESTED|SKIPPED' "$log"; then
    skip "$name" "$goal" 'no ../shared/data/cases' "$command"
else
    row "$name" "$(grep -cE '^\| [gimops][0-9]' "$log") files; docs/mesh-cases.md" "$goal" "$met" "$command"
    {
        echo '# Small files of the kinds that users have'
        echo
        echo "Written by \`make verify\` with \`$command\`."
        echo
        echo 'The second column is the README of the files, which was written independently of this program. Text in brackets states'
        echo 'what follows from the content of a file that the README calls right "as named".'
        echo
        tables
    } >docs/mesh-cases.md.new
    mv docs/mesh-cases.md.new docs/mesh-cases.md
fi

command="cargo run $profile${features:+ $features} --example aimed_rays -- $rays"
# shellcheck disable=SC2086
try rays $command
figure=$(awk -F'[:;]' '/, (vertices|edges):/ { split($2, n, " "); rays += n[1]; lost += n[2]; false_ += n[3] }
    END { print lost + 0 " lost and " false_ + 0 " false of " rays + 0 }' "$log")
case $figure in '0 lost and 0 false of '[1-9]*) ;; *) met=no ;; esac
row 'rays aimed at vertices and edges of closed meshes' "$figure" 'none' "$met" "$command"

long_only 'plans on two scenes of metal keep their tolerance' "$of_plans" few-metal '/ scenes with a line/p' \
    'cargo test --release --test points accuracy::plans_of_metal -- --ignored --nocapture'
long_only 'plans on generated scenes of metal keep their tolerance' "$of_plans" metal '/ scenes with a line/p' \
    'cargo test --release --test points accuracy::sixty -- --ignored --nocapture'

long_only 'long forms of tests of the program: acceptance test, paths that are not UTF-8' 'all pass' program \
    's/^test result: (.*)/\1/p' 'cargo test --release --test program -- --ignored'
long_only 'long forms of tests of the library: light from the cut on 200 parts, lines out of focus and blur against direct sums, all hits of 10⁶ rays against brute force' 'all pass' library \
    's/^test result: (.*)/\1/p' 'cargo test --release --lib -- --ignored'
long_only 'long forms of tests of images: speckle motion, grains and intervals against waves and laws, extreme numbers' 'all pass' images \
    's/^test result: (.*)/\1/p' 'cargo test --release --test frames -- --ignored'
long_only '95 % intervals of points, means, a step height and a sphere diameter, systematic errors drawn in each run (writes docs/systematic-coverage.md)' \
    'the exact binomial interval of each contains the expected fraction (0.001 over all)' systematic '/ of [15]000/p' \
    'env LASERTRACE_WRITE_PAGES=1 cargo test --release --test points systematic:: -- --ignored --nocapture'
long_only '95 % intervals of all kinds of features, 200 scans of each part (writes docs/feature-coverage.md)' \
    'the exact binomial interval of each contains 95 % (0.001 over all); pooled 94 to 96 %' features '/^Pooled/p' \
    'env LASERTRACE_WRITE_PAGES=1 cargo test --release --test points feature_coverage:: -- --ignored --nocapture'
long_only 'a bore at several heights and angles, 40 scans each (writes docs/ring-gauge.md)' \
    'standard deviations agree with the stated uncertainty (0.001), and mean errors are inside the interval' ring '/^test result: /p' \
    'env LASERTRACE_WRITE_PAGES=1 cargo test --release --test points ring_gauge:: -- --ignored --nocapture'
long_only 'points far from the part without a flag' 'none: the tables of docs/silent-outliers.md' outliers \
    's/^(\| all .*)/\1/p' 'cargo test --release --test points silent_outliers::report -- --ignored --nocapture'

if [ "$surfaces" = 0 ]; then
    skip 'decorrelation of speckle against wave optics' 'at most 5 outside their 95 % interval' 'not in the small form' 'lasertrace wave'
else
    command="cargo run $profile -- wave --quiet --realisations $surfaces -o $out/wave"
    # shellcheck disable=SC2086
    try wave $command
    # 17 rows, each outside its 95 % interval once in 20: more than 5 once in 6000 draws (intervals
    # of few surfaces are somewhat narrow). Seen at 80° the law is known to be off (LIMITS.md).
    # Columns: name, δ, law, texture, waves (low–high).
    figure=$(grep -v '^camera at 80' "$log" |
    sed -nE 's/^[a-z].* +[0-9.]+ +([0-9.]+) +[0-9.]+ +[0-9.]+ \(([0-9.]+)–([0-9.]+)\).*/\1 \2 \3/p' |
    awk '{ outside += $1 < $2 || $1 > $3 } END { print outside + 0 " of " NR " rows outside" }')
    case $figure in [0-5]' of 17 rows outside') ;; *) met=no ;; esac
    row 'decorrelation of speckle against wave optics' "$figure" 'at most 5 outside their 95 % interval' "$met" "$command"
fi

long_only '500 jobs of the service, of 16 clients that send each twice' \
    'none lost, none twice; memory does not grow with what passes through' service '/ clients, each sent twice/p' \
    'cargo test --release --features service --test service five_hundred -- --ignored --nocapture'

long_only 'lines out of focus against waves' 'noise within 3 %, contrast within 0.02, mean line within 0.5 %; docs/lens.md' \
    lens '/\| yes \|/{s/^\| ([^|]*) \|.*/\1: yes;/p}' 'cargo run --release --example lens -- docs'

name='a frame over what bare Embree takes for its rays'
command="cargo bench $bench ${features:---features race} --bench frame_over_embree"
LASERTRACE_PAIRS=11
export LASERTRACE_PAIRS
# The short form finds gross losses only: debug assertions slow frames, but not the rays of Embree.
was=$(sed -n 's/^frame over Embree: \([0-9.]*\).*/\1/p' docs/benchmarks.md)
goal="at most $times times the $was of docs/benchmarks.md"
# shellcheck disable=SC2086
try frame $command
figure=$(sed -n 's/^frame over Embree: \([0-9.]*\).*/\1/p' "$log")
awk -v is="$figure" -v was="$was" -v times="$times" 'BEGIN { exit !(is > 0 && is <= times * was) }' || met=no
row "$name" "$figure" "$goal" "$met" "LASERTRACE_PAIRS=11 $command"

command="cargo test${features:+ $features} --test geometry limits_mutated -- --nocapture"
LASERTRACE_FUZZ_SECONDS=$seconds
export LASERTRACE_FUZZ_SECONDS
# shellcheck disable=SC2086
try mutated $command
figure=$(awk '/ mutations, / { n += $2 } END { print n + 0 " mutations of eleven kinds of files" }' "$log")
row 'mutated files are taken or refused' "$figure" 'no panic' "$met" "LASERTRACE_FUZZ_SECONDS=$seconds $command"

for target in stl ply obj scene poses calibration png npy manifest journal shard; do
    name="fuzzing: $target"
    command="cargo +nightly fuzz run $target fuzz/corpus/$target fuzz/seeds/$target"
    if [ "$page" = "$out/small.md" ]; then
        skip "$name" 'no finding' 'not in the small form' "$command"
    elif ! cargo +nightly fuzz --version >/dev/null 2>&1; then
        skip "$name" 'no finding' 'no cargo-fuzz or no nightly compiler' "$command"
    else
        mkdir -p "fuzz/corpus/$target"
        # shellcheck disable=SC2086
        try "fuzz-$target" $command -- -max_len=4096 -max_total_time="$seconds"
        row "$name" "$(grep -E '^Done [0-9]+ runs' "$log" || echo 'did not end')" 'no finding' "$met" "$command"
    fi
done

name='advisories, licences and sources of all crates'
goal='no finding but those of deny.toml'
command='cargo deny --locked check'
if ! cargo deny --version >/dev/null 2>&1; then
    skip "$name" "$goal" 'no cargo-deny (cargo install cargo-deny)' "$command"
else
    try deny-fetch cargo deny --locked fetch db
    if [ "$met" = no ]; then
        skip 'advisories of all crates' "$goal" 'cargo deny cannot get its advisory database' "$command advisories"
        name='licences and sources of all crates' command="$command bans licenses sources"
    fi
    # shellcheck disable=SC2086
    try deny $command
    row "$name" "$(tail -n 1 "$log")" "$goal" "$met" "$command"
fi

long_only 'hostile input, sensors and faults' \
    'no panic, abort or hang, no file of others touched, no byte of difference; docs/robustness.md' \
    robustness '$p' tests/robustness.sh

# A script that takes a form of Mitsuba and prints its figure last: check, goal, form, name of the log, arguments; then
# what is built
with_mitsuba() {
    check=$1 goal=$2 form=$3 log_name=$4 command="python3 $5"
    shift 5
    if [ "$page" = "$out/small.md" ]; then
        skip "$check" "$goal" 'not in the small form' "$command"
    elif ! python3 -c "import mitsuba, numpy; mitsuba.set_variant('$form')" 2>/dev/null; then
        skip "$check" "$goal" "no mitsuba and numpy for python3 with $form (pip install mitsuba; LLVM: apt install libllvm)" "$command"
    else
        try build cargo build --release "$@"
        # shellcheck disable=SC2086
        try "$log_name" $command
        row "$check" "$(tail -n 1 "$log")" "$goal" "$met" "$command"
    fi
}

with_mitsuba 'light reflected more than once, against Mitsuba 3' \
    'totals and rows of corners, a pocket and a real part within 1 % and 5 standard errors' \
    scalar_rgb mitsuba 'tests/against_mitsuba.py target/release/examples/light_apart out/verify/mitsuba' \
    --example light_apart
with_mitsuba 'frames while Mitsuba 3 renders the direct light of one' 'the same line is seen; 100 are aimed at' \
    llvm_ad_mono speed 'tests/frames_against_mitsuba.py target/release/lasertrace out/verify/speed'
with_mitsuba 'the chart with Mitsuba 3 as a point' '95 of 100 points of the full model are found in its images' \
    llvm_ad_mono chart 'tests/chart_beside_mitsuba.py target/release/lasertrace scenes/accuracy/scene.toml out/verify/chart'

# Scans once into a folder of clouds: its name, the scene, more arguments
clouds() {
    folder=$out/$1 scene=$2
    shift 2
    # shellcheck disable=SC2086
    [ -d "$folder" ] || try scan-clouds $program scan --quiet --also e57,pcd "$scene" -o "$folder" "$@"
}

# A reader of clouds: its name in tests/cloud_readers.py, what it is called, how it is installed, a folder of clouds
with_reader() {
    check="$4 in $2" goal='every point with all its columns' command="python3 tests/cloud_readers.py $out/$4 $1"
    # shellcheck disable=SC2086
    try "$4-$1" $command
    if ! python3 -c "import numpy" 2>/dev/null; then
        skip "$check" "$goal" "no numpy for python3 (pip install numpy)" "$command"
    elif grep -q "not installed" "$log"; then
        skip "$check" "$goal" "no $2 ($3)" "$command"
    else
        row "$check" "$(tail -n 1 "$log")" "$goal" "$met" "$command"
    fi
}

if [ "$page" = "$out/small.md" ]; then
    skip 'clouds in other programs' 'every point with all its columns' 'not in the small form' 'python3 tests/cloud_readers.py'
else
    rm -rf "$out/clouds" "$out/empty-clouds"
    clouds clouds scenes/bracket/scene.toml --frames 60..70
    # Below the measuring range.
    sed 's/^rotation_deg = \[8, 5, 0\]/&\nposition_mm = [0, 0, -60]/' scenes/plane/scene.toml >"$out/empty.toml"
    clouds empty-clouds "$out/empty.toml"
    with_reader cloudcompare CloudCompare 'apt-get install cloudcompare' clouds
    with_reader pye57 pye57 'pip install pye57' clouds
    with_reader pye57 pye57 'pip install pye57' empty-clouds
    with_reader pypcd4 pypcd4 'pip install pypcd4' clouds
fi

name='all tests on Debian 13 (Embree 4)'
command='tests/debian13.sh'
if [ "$page" = "$out/small.md" ]; then
    skip "$name" passed 'not in the small form' "$command"
elif [ "$(id -u)" -ne 0 ] || ! command -v debootstrap >/dev/null; then
    skip "$name" passed 'needs root and debootstrap' "$command"
else
    try debian13 $command
    row "$name" "$(tail -n 1 "$log" | tr '|' ' ')" passed "$met" "$command"
fi

name='the same frames with every set of vector instructions'
goal='no byte of an image, a cloud or a truth differs'
command='tests/instruction_sets.sh target/release/lasertrace out/verify/instructions'
if [ "$page" = "$out/small.md" ]; then
    skip "$name" "$goal" 'not in the small form' "$command"
elif ! command -v cc >/dev/null || ! grep -q '^flags' /proc/cpuinfo 2>/dev/null; then
    skip "$name" "$goal" 'needs cc and an x86-64 machine with Linux' "$command"
else
    try build cargo build --release --bin lasertrace
    # shellcheck disable=SC2086
    [ "$met" = no ] || try instructions $command
    row "$name" "$(tail -n 1 "$log")" "$goal" "$met" "$command"
fi

long_only 'the program built without Embree' passed no-embree 's/^test result: (.*)/\1/p' \
    'cargo test --no-default-features --features cli --test points --test frames -- measure:: footprint::'

name='the tool of EMVA 1288 on simulated image sets'
command='lasertrace emva tests/emva.toml -o out/verify/emva; python3 tests/emva.py out/verify/emva'
goal='QE, K, read noise, full well, DSNU and PRNU within 2 % of what was put in'
python=$out/emva-venv/bin/python
if [ "$page" = "$out/small.md" ]; then
    skip "$name" "$goal" 'not in the small form' "$command"
elif ! { [ -x "$python" ] || python3 -m venv "$out/emva-venv"; } >"$out/emva-venv.txt" 2>&1; then
    skip "$name" "$goal" 'needs Python with venv' "$command"
elif ! "$python" -m pip install --quiet 'emva1288==1.0.2' 'numpy<2' 'scipy<1.14' >>"$out/emva-venv.txt" 2>&1; then
    # The tool calls what later versions of numpy do not have.
    skip "$name" "$goal" 'pip does not get emva1288 1.0.2' "$command"
else
    # shellcheck disable=SC2086
    try emva-images cargo run $profile -- emva --quiet tests/emva.toml -o "$out/emva"
    [ "$met" = no ] || try emva "$python" tests/emva.py "$out/emva"
    row "$name" "$(paste -sd ' ' "$log")" "$goal" "$met" "$command"
fi

name='a scan in shards on two nodes of Slurm'
command='tests/slurm.sh target/release/lasertrace'
goal='nodes killed, the bytes of an undivided scan'
if [ "$page" = "$out/small.md" ]; then
    skip "$name" "$goal" 'not in the small form' "$command"
elif [ "$(id -u)" -ne 0 ] || ! command -v slurmctld >/dev/null || ! command -v munged >/dev/null; then
    skip "$name" "$goal" 'needs root, slurm-wlm and munge' "$command"
else
    try build cargo build --release --bin lasertrace
    try slurm $command
    row "$name" "$(tail -n 1 "$log")" "$goal" "$met" "$command"
fi

name='the live view dragged in Chromium'
command='python3 tests/view_drag.py target/release/lasertrace'
goal='pictures have the bytes that render writes'
if [ "$page" = "$out/small.md" ]; then
    skip "$name" "$goal" 'not in the small form' "$command"
elif ! command -v python3 >/dev/null || ! command -v chromium >/dev/null; then
    skip "$name" "$goal" 'needs python3 and chromium' "$command"
else
    try build cargo build --release --features service --bin lasertrace
    # shellcheck disable=SC2086
    try view $command
    row "$name" "$(grep -c ': yes$' "$log") of $(grep -cE ': (yes|NO)$' "$log") hold" "$goal" "$met" "$command"
fi

name='the ways in of README.md, each with nothing built before'
command='tests/ways_in.sh out/verify/ways'
goal='a result of each; how long it took is in out/verify/ways/ways.md'
if [ "$page" = "$out/small.md" ]; then
    skip "$name" "$goal" 'not in the small form' "$command"
elif ! command -v curl >/dev/null || ! command -v pkg-config >/dev/null || ! python3 -c 'import ensurepip' 2>/dev/null; then
    skip "$name" "$goal" 'needs curl, pkg-config and python3-venv' "$command"
else
    # shellcheck disable=SC2086
    try ways $command
    row "$name" "$(sed -nE 's/^\| ([a-z-]+) \| ([0-9]+|failed) \|.*/\1 \2 s/p' "$log" | paste -sd ';' | tr ';' ',')" "$goal" "$met" "$command"
fi

. benches/conditions.sh
{
    echo '# Verification'
    echo
    echo "Written by \`make verify\`. $(conditions)"
    echo
    echo '| check | figure | goal | met | by |'
    echo '|---|---|---|---|---|'
    cat "$rows"
} >"$page.new"
mv "$page.new" "$page"
echo "$page"
exit $missed
