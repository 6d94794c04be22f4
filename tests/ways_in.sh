#!/usr/bin/env bash
# Every way in that README.md names, each with nothing built before: how long until its
# first result. Runs on a clean checkout, on Debian with Rust and with
# `apt-get install curl pkg-config python3-venv`.
#
#   tests/ways_in.sh OUT      results in OUT, with the table OUT/ways.md
set -euo pipefail
cd "$(dirname "$0")/.."
out=$(mkdir -p "${1:?usage: tests/ways_in.sh OUT}" && cd "$1" && pwd)
export PATH="$PATH:${CARGO_HOME:-$HOME/.cargo}/bin" CARGO_TERM_COLOR=never CARGO_TARGET_DIR=$out/target
example=scenes/bracket/scene.toml

# The README's code in a language.
code_of() {
    sed -n "/^\`\`\`$1\$/,/^\`\`\`\$/{/^\`\`\`/!p}" README.md
}

# The first result of a way: `way NAME FILE COMMAND`; FILE is what it must make, in OUT.
way() {
    local name=$1 file=$2 start=$SECONDS took size
    shift 2
    echo "ways_in: $name" >&2
    if "$@" >"$out/$name.log" 2>&1 && [ -s "$out/$file" ]; then
        took=$((SECONDS - start))
        size=$(stat -c %s "$out/$file")
        echo "| $name | $took | $file, $size bytes |"
    else
        tail -n 20 "$out/$name.log" >&2
        echo "| $name | failed | – |"
    fi
}

command_line() {
    make demo
    cp -r out/demo "$out/"
    cp "$CARGO_TARGET_DIR/release/lasertrace" "$out/lasertrace"
}

own_mesh() {
    "$out/lasertrace" begin scenes/bracket/bracket.stl sensors/generic-100mm-660nm.toml -o "$out/first"
    "$out/lasertrace" check "$out/first/scene.toml"
    "$out/lasertrace" scan "$out/first/scene.toml" -o "$out/first-scan"
}

# The samples of a set in one picture; and a scan in two shards, as machines take it, has the bytes of the demo.
data_set() {
    "$out/lasertrace" dataset examples/dataset/bracket.toml -o "$out/set"
    "$out/python/bin/pip" install --quiet numpy pillow
    "$out/python/bin/python" examples/dataset/read.py "$out/set"
}

shards() {
    for i in 0 1; do "$out/lasertrace" scan $example -o "$out/shards" --shard $i/2; done
    "$out/lasertrace" merge $example -o "$out/shards"
    cmp "$out/shards/cloud.ply" "$out/demo/cloud.ply"
}

service() {
    cargo build --release --features service
    cp "$CARGO_TARGET_DIR/release/lasertrace" "$out/lasertrace-service"
}

# Starts a server, asks it by `ask ADDRESS`, and ends it.
served() {
    local log=$out/served.log ask=$1 address=
    shift
    "$out/lasertrace-service" "$@" >"$log" 2>&1 &
    for _ in $(seq 100); do
        address=$(grep -o 'http://127.0.0.1:[0-9]*' "$log" | head -n 1) || sleep 0.1
        [ -z "$address" ] || break
    done
    "$ask" "$address"
    kill $!
}

ask_view() {
    curl -fsS "$1/picture.png?frame=90" -o "$out/view.png"
}

ask_service() {
    local hash job
    hash=$(sha256sum scenes/bracket/bracket.stl | cut -d' ' -f1)
    curl -fsS -T scenes/bracket/bracket.stl "$1/v1/files/$hash"
    job=$(sed "s/\"bracket.stl\"/\"sha256:$hash\"/" $example |
        curl -fsS --data-binary @- -H 'Content-Type: application/toml' "$1/v1/jobs?kind=frame&frame=90" |
        sed 's/.*"id":"\([^"]*\)".*/\1/')
    curl -fsSN "$1/v1/jobs/$job/events"
    curl -fsS "$1/v1/jobs/$job/files/frame-000090.png" -o "$out/service.png"
}

rust() {
    mkdir -p "$out/rust/src"
    code_of rust >"$out/rust/src/main.rs"
    # A workspace of its own, as OUT may lie in the project's.
    printf '[workspace]\n[package]\nname = "first"\nedition = "2024"\n[dependencies]\nlasertrace = { path = "%s", %s }\n' \
        "$PWD" 'default-features = false, features = ["embree"]' >"$out/rust/Cargo.toml"
    cargo run --release --manifest-path "$out/rust/Cargo.toml" | tee "$out/rust.txt"
}

c() {
    bindings/c/install.sh "$out/c"
    export PKG_CONFIG_PATH=$out/c/lib/pkgconfig LD_LIBRARY_PATH=$out/c/lib
    # shellcheck disable=SC2046
    cc bindings/c/examples/cast.c $(pkg-config --cflags --libs lasertrace) -lm -o "$out/cast"
    "$out/cast" | tee "$out/c.txt"
}

python() {
    python3 -m venv "$out/python"
    "$out/python/bin/pip" install --quiet ./bindings/python
    # The rays are the reader's.
    code_of python | sed '/^hits/d' >"$out/first.py"
    "$out/python/bin/python" "$out/first.py" | tee "$out/python.txt"
}

anew() {
    rm -rf "$CARGO_TARGET_DIR"
    "$@"
}

{
    . /etc/os-release
    echo "$PRETTY_NAME, $(nproc) cores, load $(cut -d' ' -f1 /proc/loadavg) at the start:"
    echo
    echo '| way in | s | first result |'
    echo '|---|---|---|'
    way command-line demo/report.html anew command_line
    way own-mesh first-scan/report.html own_mesh
    way shards shards/cloud.ply shards
    way python python.txt anew python
    way data-set set/overview.png data_set
    way service-built lasertrace-service anew service
    way view view.png served ask_view view $example
    way service service.png served ask_service serve --store "$out/store" --listen 127.0.0.1:18787
    way rust rust.txt anew rust
    way c c.txt anew c
} | tee "$out/ways.md"
rm -rf "$CARGO_TARGET_DIR"
! grep -q '| failed |' "$out/ways.md"
