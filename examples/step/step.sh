#!/bin/sh
# A STEP file as triangles whose distance from its surfaces is bounded, by Open CASCADE's test
# program in a process of its own:
#
#   examples/step/step.sh PART.stp PART.stl CHORD_UM
#
# Debian: apt-get install occt-draw libocct-draw-dev. Lengths come out in millimetres, whatever
# the STEP file's unit. In the scene: mesh = { file = "PART.stl", unit = "mm", chordal_deviation_um = CHORD_UM }
set -eu

usage() {
    sed -n '2,/^set/s/^# \{0,1\}//p' "$0" >&2
    exit 64
}
[ $# -eq 3 ] || usage
step=$(realpath -- "$1") output=$2 chordal_deviation_um=$3
[ -f "$step" ] || { echo "step.sh: $1: no such file" >&2; exit 66; }
chord_mm=$(echo "$chordal_deviation_um" | awk '$1 + 0 > 0 { printf "%.9g", $1 / 1000 }')
[ -n "$chord_mm" ] || { echo "step.sh: found a chord of '$chordal_deviation_um', expected micrometres > 0" >&2; exit 64; }
command -v occt-draw >/dev/null || {
    echo "step.sh: there is no occt-draw (apt-get install occt-draw libocct-draw-dev)" >&2
    exit 69
}
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
# Names of files are not words of the program.
ln -s "$step" "$folder/in.stp"
cat >"$folder/convert.tcl" <<TCL
if {[catch {
    pload MODELING XDE
    stepread $folder/in.stp part *
    compound {*}[directory part_*] whole
    incmesh whole $chord_mm
    writestl whole $folder/out.stl 1
} message]} { puts stderr \$message }
exit
TCL
occt-draw -b -f "$folder/convert.tcl" >"$folder/log" 2>&1 || true
[ -s "$folder/out.stl" ] || {
    echo "step.sh: $1: occt-draw made no triangles of it:" >&2
    tail -n 5 "$folder/log" >&2
    exit 65
}
# Whole or not at all.
cp "$folder/out.stl" "$output.part"
mv "$output.part" "$output"
