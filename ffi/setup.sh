#!/bin/sh
# Sees to what the build needs besides Rust: Embree, libclang (bindgen reads the
# headers through it), a C compiler and make. What is missing is installed with
# apt-get; when nothing is missing, nothing is asked of the network. Presence is
# found by trying, not by package name, so a hand-built Embree counts too.
set -eu
cd "$(dirname "$0")/.."

scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
trap 'exit 130' INT TERM

say() {
    printf 'setup: %s\n' "$*" >&2
}

fail() {
    say "$@"
    exit 1
}

# Compiles and links standard input; the arguments go to the linker.
# CC may hold a command with options, hence no quotes.
links() {
    # shellcheck disable=SC2086
    ${CC:-cc} -x c -o "$scratch/probe" - "$@" 2>/dev/null
}

has_c_compiler() {
    echo '#include <stdio.h>
        int main(void) { return puts(""); }' | links
}

has_embree() {
    for version in 4 3; do
        echo "#include <embree$version/rtcore.h>
            int main(void) { return rtcNewDevice(0) == 0; }" |
            links "-lembree$version" && return
    done
    return 1
}

# The unversioned name: a libclang.so.N alone comes without the compiler's own
# headers (stddef.h), and bindgen then fails. LIBCLANG_PATH is bindgen's own
# override and is believed if it holds any libclang.
has_libclang() {
    if [ -n "${LIBCLANG_PATH:-}" ]; then
        set -- "$LIBCLANG_PATH" "$LIBCLANG_PATH"/libclang*
    else
        set -- /usr/lib/llvm-*/lib/libclang.so /usr/lib/*/libclang.so \
            /usr/lib/libclang.so /usr/lib64/libclang.so /usr/local/lib/libclang.so
    fi
    for library in "$@"; do
        [ -f "$library" ] && return
    done
    { ldconfig -p || /sbin/ldconfig -p; } 2>/dev/null | grep -q 'libclang\.so '
}

# Debian's names of the packages that are missing. Embree cannot be looked for
# without a compiler; apt-get skips it if it is there after all.
missing_packages() {
    command -v make >/dev/null || echo make
    if has_c_compiler; then
        has_embree || echo libembree-dev
    else
        echo gcc libc6-dev libembree-dev
    fi
    has_libclang || echo libclang-dev
}

as_root() {
    if [ "$(id -u)" -eq 0 ]; then
        "$@"
    else
        sudo "$@"
    fi
}

install_packages() {
    needed="a C compiler, make, Embree 3.13 or 4 with its headers, libclang with its headers"
    command -v apt-get >/dev/null ||
        fail "missing here (by Debian's names): $*. There is no apt-get to install it with;" \
            "needed in all: $needed. Install these, then run the same command again."
    command="apt-get install -y --no-install-recommends $*"
    if [ "$(id -u)" -ne 0 ]; then
        command -v sudo >/dev/null ||
            fail "missing: $*. Neither root nor sudo is at hand; as root, run: $command"
        command="sudo $command"
    fi
    say "missing: $*"
    say "now running: apt-get update, then: $command"
    # A stale or broken third-party source must not stop what Debian itself has.
    as_root apt-get -q update >&2 || say "apt-get update failed; going on with the lists at hand"
    as_root env DEBIAN_FRONTEND=noninteractive \
        apt-get -q install -y --no-install-recommends "$@" >&2 ||
        fail "apt-get could not install: $*"
}

# True if dotted version $1 is older than $2.
older() {
    [ "$1" != "$2" ] && [ "$(printf '%s\n%s\n' "$1" "$2" |
        sort -t. -k1,1n -k2,2n -k3,3n | head -n 1)" = "$1" ]
}

check_rust() {
    wanted=$(sed -n 's/^rust-version = "\(.*\)"$/\1/p' Cargo.toml)
    how="get it from https://rustup.rs (Debian's own may be too old), then run the same command again"
    command -v cargo >/dev/null || fail "Rust $wanted or newer is needed and cargo is not on PATH: $how"
    found=$(rustc --version 2>/dev/null | sed 's/^rustc \([0-9.]*\).*/\1/')
    [ -n "$found" ] || fail "cargo is there, but rustc does not run: try 'rustup default stable'"
    if older "$found" "$wanted"; then
        fail "Rust $wanted or newer is needed, $(command -v rustc) is $found: 'rustup update', or $how"
    fi
}

packages=$(missing_packages)
if [ -n "$packages" ]; then
    # shellcheck disable=SC2086 # one word a package
    install_packages $packages
    packages=$(missing_packages)
    # shellcheck disable=SC2086
    [ -z "$packages" ] || fail "still not found after the installation:" $packages
fi
check_rust
