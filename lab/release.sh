#!/bin/sh
# Builds a release: release.sh FOLDER. Writes the stripped program and the Python wheel.
# Compares the public Rust interface with the last tag, or with the parent commit if there is no tag,
# and checks licences and advisories. A missing tool is named, and its check is skipped.
set -eu
cd "$(dirname "$0")/.."
folder=${1:?usage: release.sh FOLDER}
mkdir -p "$folder"

skipped() {
    echo "release.sh: SKIPPED: $1 (cargo install $2)" >&2
}

if [ -n "$(git status --porcelain)" ]; then
    echo "release.sh: found uncommitted changes; commit them first" >&2
    exit 1
fi
base=$(git describe --tags --abbrev=0 2>/dev/null || git rev-parse HEAD^)
if cargo semver-checks --version >/dev/null 2>&1; then
    cargo semver-checks -p lasertrace --baseline-rev "$base"
else
    skipped "comparison of the public interface with $base" cargo-semver-checks
fi
if cargo deny --version >/dev/null 2>&1; then
    cargo deny --locked check bans licenses sources
    cargo deny --locked check advisories || echo "release.sh: advisories NOT checked or found, see above" >&2
else
    skipped 'licences and advisories' cargo-deny
fi

cargo build --release --locked --features service
program=${CARGO_TARGET_DIR:-target}/release/lasertrace
strip -o "$folder/lasertrace" "$program"
"$folder/lasertrace" --version
for file in "$program" "$folder/lasertrace"; do
    echo "release.sh: $file: $(($(wc -c <"$file") / 1000000)) MB"
done
bindings/python/wheel.sh "$folder"
