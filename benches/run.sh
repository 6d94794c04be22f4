#!/bin/sh
# Runs the benches. Figures are ratios, since times differ from machine to machine.
#
#   benches/run.sh            writes docs/benchmarks.md
#   benches/run.sh GIT-REF    holds this checkout against that one, the two in turn, and
#                             writes out/bench/against.md; fails if a figure is larger than
#                             LIMIT times that one's in every round
#
#   BENCHES="frame speckle"   only these
#   ROUNDS=5                  how often the two take turns
#   LIMIT=1.1
#   LASERTRACE_BENCH_LARGE=1  also 12.9 million triangles: minutes more, 3 GB
#   LASERTRACE_PAIRS=11       fewer pairs than 51 for frame_over_embree
set -eu

cd "$(dirname "$0")/.."
PATH=$PATH:${CARGO_HOME:-$HOME/.cargo}/bin
export CARGO_TERM_COLOR=never LC_ALL=C
benches=${BENCHES:-$(ls benches/*.rs | sed 's,.*/,,; s,\.rs$,,')}
out=$PWD/out/bench
mkdir -p "$out"

# Runs a bench of the checkout in a folder; what it prints goes to a file.
run() {
    # Not piped, which would hide that a bench failed.
    (cd "$1" && cargo bench --features race --bench "$2" -- --measurement-time 2) >"$3" 2>&1 || {
        tail -n 20 "$3" >&2
        echo "bench: $2 failed in $1" >&2
        exit 70
    }
}

# Of what benches print: name, tab, figure; times in ns.
figures() {
    awk -v OFS='\t' '
        /time: +\[/ {
            name = $0; sub(/ *time:.*/, "", name); if (name == "") name = before
            unit = $0; sub(/.*\[/, "", unit); split(unit, part, " ")
            scale["ns"] = 1; scale["ms"] = 1e6; scale["s"] = 1e9
            print name, part[3] * (part[4] in scale ? scale[part[4]] : 1e3)
        }
        / \(median of / { name = $0; sub(/: [0-9.]+ \(median.*/, "", name)
            value = $0; sub(/ \(median.*/, "", value); sub(/.*: /, "", value); print name, value }
        /^\| [a-z]/ && $4 ~ /^[0-9.]+$/ { print "frame over Embree, " $2, $4 }
        { before = $0 }' "$1"
}

# Of what a bench printed: rows of the page.
ratios() {
    sed -nE "s/^(.*): ([0-9.]+) \(median of ([0-9]+) pairs; quartiles (.*), (.*)\)$/\
| $1 | \1 | \2 | \4 to \5 | \3 |/p" "$out/$1.txt"
}

. benches/conditions.sh

if [ $# -eq 0 ]; then
    page=docs/benchmarks.md
    {
        echo '# Benchmarks'
        echo
        echo 'Written by `make bench`; `make bench BASE=GIT-REF` holds two checkouts against each other.'
        echo
        echo '| bench | ratio | median | quartiles | pairs |'
        echo '|---|---|---|---|---|'
        for bench in $benches; do
            echo "bench: $bench" >&2
            run . "$bench" "$out/$bench.txt"
            ratios "$bench"
        done
        echo 'bench: through_c' >&2
        cargo build --quiet --release -p lasertrace-c >&2
        cargo bench --quiet -p lasertrace-c >"$out/through_c.txt"
        ratios through_c
        echo 'bench: through_python' >&2
        bindings/python/bench.sh --core >"$out/through_python.txt"
        ratios through_python
        for bench in $benches; do
            [ "$bench" != frame_over_embree ] || { echo; grep -E '^\||^frame over' "$out/$bench.txt"; }
        done
        echo
        echo '## Ray casting from Python, and its peers'
        echo
        echo 'The table lists Mrays/s against a sphere. Peers in Rust are called from Rust, with prepared rays in f32.'
        echo
        bindings/python/bench.sh
        echo
        conditions
    } >"$out/page.md"
    mv "$out/page.md" "$page"
    echo "$page"
    exit
fi

base=target/bench-base
git rev-parse --verify --quiet "$1^{commit}" >/dev/null || {
    echo "bench: found '$1', expected a commit, branch or tag" >&2
    exit 64
}
if [ -d "$base" ]; then
    git -C "$base" checkout --quiet --force --detach "$(git rev-parse "$1")"
else
    git worktree prune
    git worktree add --quiet --detach "$base" "$1"
fi
: >"$out/pairs.tsv"
for bench in $benches; do
    [ -f "$base/benches/$bench.rs" ] || { echo "bench: $1 has no $bench" >&2; continue; }
    for round in $(seq "${ROUNDS:-5}"); do
        echo "bench: $bench, round $round" >&2
        # The first of a round is not always the same.
        if [ $((round % 2)) -eq 0 ]; then order=". $base"; else order="$base ."; fi
        for tree in $order; do
            run "$tree" "$bench" "$out/$(basename "$(realpath "$tree")").$bench.txt"
        done
        figures "$out/$(basename "$base").$bench.txt" >"$out/base.tsv"
        figures "$out/$(basename "$PWD").$bench.txt" |
            awk -F'\t' -v OFS='\t' -v bench="$bench" \
                'NR == FNR { base[$1] = $2; next } $1 in base { print bench, $1, $2 / base[$1] }' \
                "$out/base.tsv" - >>"$out/pairs.tsv"
    done
done
{
    echo "# This checkout over $(git describe --always "$1")"
    echo
    echo '| bench | figure | ratio, median | least to most | rounds |'
    echo '|---|---|---|---|---|'
    sort -t "$(printf '\t')" -k1,2 -k3,3g "$out/pairs.tsv" | awk -F'\t' '
        function row() { if (n) printf "| %s | %.3f | %.3f to %.3f | %d |\n", name,
            (v[int((n + 1) / 2)] + v[int(n / 2) + 1]) / 2, v[1], v[n], n }
        $1 " | " $2 != name { row(); name = $1 " | " $2; n = 0 }
        { v[++n] = $3 }
        END { row() }'
    echo
    conditions
} >"$out/against.md"
cat "$out/against.md"
# By chance a round is slower, but not all of them. Of rates, and of what slow ways take over ours, more is better.
limit=${LIMIT:-1.1}
awk -F'\t' -v limit="$limit" '
    $2 ~ / a second| \/ footprint/ { next }
    { name = $1 ", " $2; if (!(name in least) || $3 < least[name]) least[name] = $3 }
    END { for (name in least) if (least[name] > limit) {
              printf "bench: %s: at least %.3f times as much, the limit is %s\n", name, least[name], limit
              slower = 1 }
          exit slower }' "$out/pairs.tsv" >&2
