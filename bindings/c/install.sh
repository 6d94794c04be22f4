#!/bin/sh
# Installs the C library: bindings/c/install.sh PREFIX [FOLDER]
# Header, shared and static library and the pkg-config file go below PREFIX, as a whole path.
# The libraries are those in FOLDER; without it they are built, optimised.
set -eu
prefix=${1:?usage: bindings/c/install.sh PREFIX [FOLDER OF THE LIBRARIES]}
case $prefix in
/*) ;;
*)
    echo "install.sh: found $prefix, expected a whole path, as /usr/local" >&2
    exit 64
    ;;
esac
here=$(cd "$(dirname "$0")" && pwd)
folder=${2:-}
if [ -z "$folder" ]; then
    (cd "$here/../.." && cargo build --release -p lasertrace-c)
    folder=${CARGO_TARGET_DIR:-$here/../../target}/release
fi
version=$(sed -n 's/^version = "\(.*\)"$/\1/p' "$here/Cargo.toml" | head -1)
# The Embree that the library was linked with, 3 or 4.
embree=$(grep -aoE 'libembree[0-9]+\.so' "$folder/liblasertrace.so" | head -1 | sed 's/^lib//; s/\.so$//')
mkdir -p "$prefix/include" "$prefix/lib/pkgconfig"
install -m 644 "$here/include/lasertrace.h" "$prefix/include/"
install -m 644 "$folder/liblasertrace.a" "$prefix/lib/"
# Programs ask for the first two numbers of the version (build.rs): a newer patch will do.
soname=liblasertrace.so.${version%.*}
install -m 755 "$folder/liblasertrace.so" "$prefix/lib/$soname"
# What debuggers read is most of their size: 72 of 79 MB of the shared one.
strip --strip-debug "$prefix/lib/liblasertrace.a" "$prefix/lib/$soname" ||
    echo "install.sh: strip (apt-get install binutils) failed: the libraries keep what debuggers read" >&2
ln -sf "$soname" "$prefix/lib/liblasertrace.so"
sed -e "s|@PREFIX@|$prefix|; s|@VERSION@|$version|; s|-l@EMBREE@|${embree:+-l$embree}|" \
    "$here/lasertrace.pc.in" >"$prefix/lib/pkgconfig/lasertrace.pc"
