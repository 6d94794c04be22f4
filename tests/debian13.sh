#!/usr/bin/env bash
# Runs `make test` on a fresh Debian 13 (trixie), the release with Embree 4,
# whatever release the host is: in a chroot made with debootstrap, on a clean
# checkout of HEAD, with the host's Rust toolchain. Needs root and debootstrap.
#
#   tests/debian13.sh [--keep DIRECTORY] [--demo] [--ways]
#
#   --keep DIRECTORY  make the chroot there and leave it; a later run with the
#                     same directory skips debootstrap and builds incrementally
#   --demo            run `make demo` too; with --keep its output is left in
#                     DIRECTORY/root/lasertrace/out/demo
#   --ways            try the README's ways in (tests/ways_in.sh) in place of the
#                     tests; results in the checkout's out/ways
#
# The Debian mirror, proxy and certificates are the host's; where the host's apt
# knows no Debian mirror, name one in DEBIAN_MIRROR.
set -euo pipefail

checkout=/root/lasertrace
certificates=/etc/ssl/host.crt
toolchain=/opt/rust
proxies=(http_proxy https_proxy no_proxy HTTP_PROXY HTTPS_PROXY NO_PROXY)

say() {
    echo "debian13: $*" >&2
}

fail() {
    say "$@"
    exit 1
}

usage() {
    sed -n '/^#   tests/s/^# */usage: /p' "$0" >&2
    exit 64
}

# `mount` may have been interrupted half-way: what counts is what is mounted.
unmount_all() {
    local point
    cut -d' ' -f2 /proc/self/mounts | grep "^$root/" | sort -r | while read -r point; do
        umount "$point" || umount -l "$point"
    done
}

cleanup() {
    unmount_all || true
    if [ "$keep" = no ]; then
        # The toolchain is mounted below: never delete through it.
        if cut -d' ' -f2 /proc/self/mounts | grep -q "^$root/"; then
            fail "$root is still mounted; left as it is"
        fi
        rm -rf --one-file-system "$root"
    fi
}

debian_mirror() {
    if [ -n "${DEBIAN_MIRROR:-}" ]; then
        echo "$DEBIAN_MIRROR"
        return
    fi
    # shellcheck disable=SC2016 # the variable is apt's
    apt-get indextargets --format '$(REPO_URI)' 'Created-By: Packages' 'Label: Debian' |
        sed -n 1p
}

bootstrap() {
    local mirror http_proxy_of_apt=
    mirror=$(debian_mirror)
    if [ -z "$mirror" ]; then
        apt-get -q update >&2
        mirror=$(debian_mirror)
    fi
    [ -n "$mirror" ] || fail "the host's apt knows no Debian mirror: name one in DEBIAN_MIRROR"
    eval "$(apt-config shell http_proxy_of_apt Acquire::http::Proxy)"
    if [ -n "$http_proxy_of_apt" ] && [ -z "${http_proxy:-}" ]; then
        export http_proxy=$http_proxy_of_apt
    fi
    say "debootstrap trixie into $root"
    debootstrap --variant=minbase trixie "$root" "$mirror" >"$root.log" 2>&1 || {
        tail -n 20 "$root.log" >&2
        fail "debootstrap failed"
    }
    rm -f "$root.log"
    touch "$root/.bootstrapped"
}

# Name resolution, proxy, certificates and cargo's settings, as on the host.
copy_network_settings() {
    local cargo_home=${CARGO_HOME:-$HOME/.cargo} file
    local bundle=${SSL_CERT_FILE:-/etc/ssl/certs/ca-certificates.crt}
    for file in /etc/resolv.conf /etc/hosts; do
        if [ -f "$file" ]; then
            cp -L "$file" "$root$file"
        fi
    done
    apt-config dump |
        grep -E '^Acquire::(https?|ftp|Retries|Check-Date|Check-Valid-Until)\b.* ".+";' \
            >"$root/etc/apt/apt.conf.d/90host" || true
    # Certificates and keys which those settings name by path.
    sed -n 's|.* "\(/.*\)";$|\1|p' "$root/etc/apt/apt.conf.d/90host" | while read -r file; do
        if [ -f "$file" ]; then
            cp -L --parents "$file" "$root"
        fi
    done
    mkdir -p "$root/etc/ssl/certs" "$root/root/.cargo/registry"
    if [ -f "$bundle" ]; then
        cp -L "$bundle" "$root/etc/ssl/certs/ca-certificates.crt"
        # Not written over by Debian's package of certificates.
        cp -L "$bundle" "$root$certificates"
    fi
    for file in config.toml registry/index registry/cache; do
        if [ -e "$cargo_home/$file" ]; then
            cp -ruT "$cargo_home/$file" "$root/root/.cargo/$file"
        fi
    done
}

# The toolchain's own folder, not rustup's: read-only, so that nothing done in
# the chroot reaches the host.
mount_toolchain() {
    local sysroot
    sysroot=$(rustc --print sysroot)
    if [ ! -x "$sysroot/bin/cargo" ] || [ "$sysroot" = /usr ]; then
        fail "needs a Rust toolchain in a folder of its own, as rustup makes; found $sysroot"
    fi
    mkdir -p "$root$toolchain"
    mount --bind "$sysroot" "$root$toolchain"
    mount -o remount,bind,ro "$root$toolchain"
    mount -t proc proc "$root/proc"
}

# HEAD as a fresh clone has it; only cargo's target folder stays from last time.
# Files get the present time (tar -m): with the commit's, cargo could take a
# changed file for older than what it built from the previous one.
check_out() {
    mkdir -p "$root$checkout"
    find "$root$checkout" -mindepth 1 -maxdepth 1 ! -name target -exec rm -rf {} +
    [ -z "$(git status --porcelain)" ] || say "uncommitted changes are left out: HEAD is tested"
    commit=$(git rev-parse --short HEAD)
    git archive "$commit" | tar -xm -C "$root$checkout"
}

inside() {
    local settings=() name
    for name in "${proxies[@]}"; do
        if [ -n "${!name:-}" ]; then
            settings+=("$name=${!name}")
        fi
    done
    env -i HOME=/root LANG=C.UTF-8 TERM="${TERM:-dumb}" \
        PATH="$toolchain/bin:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin" \
        SSL_CERT_FILE=$certificates PIP_CERT=$certificates "${settings[@]}" \
        chroot "$root" sh -euc "cd $checkout; $1"
}

keep=no demo=no ways=no root=
while [ $# -gt 0 ]; do
    case $1 in
    --keep)
        [ $# -ge 2 ] || usage
        keep=yes root=$2
        shift
        ;;
    --demo) demo=yes ;;
    --ways) ways=yes ;;
    *) usage ;;
    esac
    shift
done

cd "$(dirname "$0")/.."
[ "$(id -u)" -eq 0 ] || fail "needs root (debootstrap, mount, chroot)"
for tool in debootstrap git rustc; do
    command -v "$tool" >/dev/null || fail "needs $tool"
done
if [ "$keep" = yes ]; then
    mkdir -p "$root"
    root=$(realpath "$root")
    [ -f "$root/.bootstrapped" ] || [ -z "$(ls -A "$root")" ] ||
        fail "$root is neither empty nor a chroot that this script finished: remove it or name another"
else
    # Not /tmp, which may forbid device files and may be held in memory.
    root=$(mktemp -d /var/tmp/debian13.XXXXXX)
fi
trap cleanup EXIT
trap 'exit 130' INT TERM

[ -f "$root/.bootstrapped" ] || bootstrap
copy_network_settings
mount_toolchain
check_out
# minbase has no make, which whoever types `make test` has: setup.sh brings it.
inside 'sh ffi/setup.sh'
if [ "$ways" = yes ]; then
    inside 'apt-get -qq install --yes curl pkg-config python3-venv >/dev/null'
    inside 'tests/ways_in.sh out/ways'
else
    inside 'make test'
fi
[ "$demo" = no ] || inside 'make demo'
# shellcheck disable=SC2016 # the variable is the chroot's
inside '. /etc/os-release; echo "$PRETTY_NAME"; dpkg-query -W "libembree*"'
say "passed on Debian 13: $commit"
