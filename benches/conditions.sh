# For other scripts to read: what a page of figures says of where they are from.
conditions() {
    for simd in avx512f avx2 sse4_2 ''; do
        if grep -m1 '^flags' /proc/cpuinfo | grep -qw "$simd"; then break; fi
    done
    echo "Version $(git describe --always --dirty), $(date -u +%Y-%m-%d); $(uname -m)," \
        "$(nproc) threads, $simd; load $(cut -d' ' -f1 /proc/loadavg) at the end."
}
