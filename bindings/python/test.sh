#!/bin/sh
# Tests the Python package: creates a venv below target/, builds the package, and runs tests and
# examples. It is skipped, with the reason, if Python is missing or PyPI cannot be reached.
set -eu
cd "$(dirname "$0")"
root=$(cd ../.. && pwd)
target=${CARGO_TARGET_DIR:-$root/target}
venv=$target/python

skip() {
    echo "bindings/python/test.sh: SKIPPED, the Python package is NOT tested: $*" >&2
    exit 0
}

command -v python3 >/dev/null || skip "there is no python3 (apt-get install python3-venv)"
python3 -c 'import sys; sys.exit(sys.version_info < (3, 9))' || skip "Python 3.9 or newer is needed"
if [ ! -x "$venv/bin/python" ]; then
    rm -rf "$venv"
    python3 -m venv "$venv" 2>/dev/null || {
        rm -rf "$venv"
        skip "python3 -m venv does not work (apt-get install python3-venv)"
    }
    "$venv/bin/pip" -q --disable-pip-version-check --retries 1 install numpy pillow || {
        rm -rf "$venv"
        skip "pip could not install numpy and pillow"
    }
fi

# With the packages and features of `make test`, cargo uses the library that the tests compiled.
# `wheel.sh` tests the package as maturin builds it.
(cd "$root" && PYO3_PYTHON=$venv/bin/python PYO3_BUILD_EXTENSION_MODULE=1 cargo build -q \
    -p lasertrace -p lasertrace-c -p lasertrace-python \
    --features lasertrace/service,lasertrace/race --lib --test program)
cp "$target/debug/lib_core.so" python/lasertrace/_core.abi3.so
export PYTHONPATH="$PWD/python"
LASERTRACE=$target/debug/lasertrace \
    "$venv/bin/python" -X dev -W error::RuntimeWarning -m unittest discover -s tests "$@"
# The stubs say what the package has.
if "$venv/bin/pip" -q --disable-pip-version-check --retries 1 install mypy; then
    (cd "$target" && "$venv/bin/python" -m mypy.stubtest lasertrace --concise)
else
    echo "bindings/python/test.sh: SKIPPED, the type stubs are NOT tested: pip could not install mypy" >&2
fi
"$venv/bin/python" examples/cast_rays.py 100000
"$venv/bin/python" examples/dataset.py "$target/python-dataset" 2
