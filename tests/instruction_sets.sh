#!/bin/sh
# Takes the same frames with every set of vector instructions that the machine and Embree offer
# and compares the bytes of images, clouds and truth. Prints the figures last; fails if a byte
# differs. The same frames are taken with the C library's sine, exponential and so on for
# processors without FMA, whose last bit may be another. Where qemu-x86_64 is installed, frames
# are also taken on an emulated processor without AVX: this changes the instructions of all
# libraries, such as those for Fourier transforms.
#
#   tests/instruction_sets.sh PROGRAM OUT [small]
set -eu

program=$1 out=$2 form=${3:-long}
cd "$(dirname "$0")/.."
rm -rf "$out"
mkdir -p "$out"
out=$(cd "$out" && pwd)

# Embree takes its instructions from the text by which a device is made.
cat >"$out/isa.c" <<'END'
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>
void *rtcNewDevice(const char *config) {
  void *(*make)(const char *) = (void *(*)(const char *))dlsym(RTLD_NEXT, "rtcNewDevice");
  char text[256];
  snprintf(text, sizeof text, "%s,isa=%s", config ? config : "", getenv("LASERTRACE_ISA"));
  return make(text);
}
END
cc -shared -fPIC -o "$out/isa.so" "$out/isa.c" -ldl

# Embree's names and what /proc/cpuinfo calls what they need. (A name that Embree does not know
# means SSE2 to it.)
sets=
for pair in sse2:sse2 sse4.2:sse4_2 avx:avx avx2:avx2 avx512:avx512vl; do
    if grep -qw "${pair#*:}" /proc/cpuinfo; then sets="$sets ${pair%:*}"; fi
done

# Takes the frames of a scene in a folder: scene, first frame, frame behind the last, speckle.
take() {
    scene=$1 from=$2 to=$3 values=$4 folder=$5
    mkdir -p "$folder"
    sed "s/^speckle = .*/speckle = $values/" "$scene" >"$folder.toml"
    # Files that the scene names lie beside it.
    cp "$folder.toml" "$(dirname "$scene")/.isa-$$.toml"
    trap 'rm -f "$(dirname "$scene")/.isa-$$.toml"' EXIT
    at=$(dirname "$scene")/.isa-$$.toml
    $run "$program" scan "$at" --quiet --frames "$from..$to" -o "$folder/scan" >/dev/null
    frame=$from
    while [ "$frame" -lt "$to" ]; do
        $run "$program" render "$at" --quiet --frame "$frame" -o "$folder/render" >/dev/null
        frame=$((frame + (to - from + 2) / 3))
    done
    rm -f "$at"
    trap - EXIT
}

# Sums of what depends on the simulation alone; manifests name times.
sums() {
    (cd "$1" && find . -name '*.png' -o -name '*.exr' -o -name '*.ply' | LC_ALL=C sort | xargs sha256sum)
}

compared=0 different=0 failed=0 taken=
scans='scenes/bracket/scene.toml:58:64:true scenes/limits/edge/scene.toml:0:1:true scenes/step/scene.toml:0:3:true
    scenes/plane/scene.toml:3:4:true'
[ "$form" = small ] || scans='scenes/bracket/scene.toml:0:219:true scenes/accuracy/scene.toml:40:100:true
    scenes/balls/scene.toml:0:401:true scenes/plane/scene.toml:0:9:true scenes/step/scene.toml:0:9:true
    scenes/rotary/scene.toml:0:36:true scenes/metal/scene.toml:0:3:true scenes/limits/edge/scene.toml:0:1:true
    scenes/limits/grazing/scene.toml:0:3:true scenes/limits/border/scene.toml:0:3:true'

# Compares a folder with that of the machine's own instructions: folder, own, what they are.
compare() {
    sums "$1" >"$1.sums"
    sums "$2" >"$2.sums"
    [ -s "$2.sums" ] || failed=1
    compared=$((compared + $(wc -l <"$2.sums")))
    lines=$(diff "$1.sums" "$2.sums" | grep -c '^[<>]') || true
    if [ "$lines" -gt 0 ]; then
        different=$((different + (lines + 1) / 2))
        echo "$3: $(basename "$1"): differs" >&2
    fi
}

number=0
for scan in $scans; do
    number=$((number + 1))
    IFS=: read -r scene from to speckle <<END
$scan
END
    run=
    take "$scene" "$from" "$to" "$speckle" "$out/own-$number"
    for set in $sets no-fma; do
        run="env LASERTRACE_ISA=$set LD_PRELOAD=$out/isa.so"
        [ "$set" != no-fma ] || run='env GLIBC_TUNABLES=glibc.cpu.hwcaps=-FMA,-FMA4,-AVX2,-AVX'
        take "$scene" "$from" "$to" "$speckle" "$out/$set-$number"
        compare "$out/$set-$number" "$out/own-$number" "$scene with $set"
    done
done
taken="$(echo $sets) and the C library without FMA"

# Takes a frame of a scene on both processors: scene, frame, folder.
emulate() {
    run=
    take "$1" "$2" $(($2 + 1)) true "$out/own-$3"
    run='qemu-x86_64 -cpu Nehalem'
    take "$1" "$2" $(($2 + 1)) true "$out/emulated-$3"
    compare "$out/emulated-$3" "$out/own-$3" 'an emulated processor without AVX'
}

if command -v qemu-x86_64 >/dev/null; then
    emulate scenes/plane/scene.toml 3 plane
    if [ "$form" != small ]; then
        emulate scenes/bracket/scene.toml 60 bracket
        emulate scenes/metal/scene.toml 0 metal
        emulate scenes/rotary/scene.toml 5 rotary
    fi
    taken="$taken, and on an emulated processor without AVX"
fi

echo "$different of $compared files of $number scenes differ between $taken"
[ "$different" -eq 0 ] && [ "$failed" -eq 0 ]
