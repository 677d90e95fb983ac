# shellcheck shell=sh
# What the scripts share: what they need is installed, or said. Sourced, not run.

give_up() {
    echo "$0: $*" >&2
    exit 1
}

# Installs Debian packages, or says that they are to be installed. Talks to stderr: stdout is the caller's.
install_packages() {
    if ! command -v apt-get >/dev/null; then
        give_up "needs what Debian calls $*: install it and run this again"
    elif [ "$(id -u)" -eq 0 ]; then
        as_root=
    elif command -v sudo >/dev/null && sudo -n true 2>/dev/null; then
        as_root=sudo
    else
        give_up "missing packages; install them and run this again: sudo apt-get install $*"
    fi
    # A stale or unreachable list of packages is no reason to stop before the installation has been tried.
    $as_root env DEBIAN_FRONTEND=noninteractive apt-get update --quiet >&2 || true
    $as_root env DEBIAN_FRONTEND=noninteractive apt-get install --yes --quiet --no-install-recommends "$@" >&2
}

ready_cargo() {
    # A shell that was open before rustup ran does not know cargo yet.
    if ! command -v cargo >/dev/null && [ -f "${CARGO_HOME:-$HOME/.cargo}/env" ]; then
        . "${CARGO_HOME:-$HOME/.cargo}/env"
    fi
    command -v cargo >/dev/null || give_up "needs cargo: install Rust from https://rustup.rs and run this again"
}

exists() { [ -e "$1" ]; }

has_libclang() {
    exists "${LIBCLANG_PATH:-}" && return 0
    for found in /usr/lib/llvm-*/lib/libclang.so* /usr/lib/llvm-*/lib/libclang-[0-9]*.so* /usr/lib/*/libclang-[0-9]*.so*; do
        if exists "$found"; then
            for header in /usr/lib/llvm-*/lib/clang/*/include/stddef.h /usr/lib/clang/*/include/stddef.h; do
                exists "$header" && return 0
            done
        fi
    done
    return 1
}

# The camera driver's bindings are made from the kernel's headers, for which libclang and its own headers are needed.
ready_libclang() {
    if ! has_libclang; then
        # Of Debian 12 and Raspberry Pi OS 12; elsewhere the version differs, and libclang-dev brings more than is needed.
        install_packages libclang1-14 libclang-common-14-dev || install_packages libclang-dev
    fi
}

# Where large things that are the same for every run are kept.
omniloc_cache() { echo "${OMNILOC_CACHE:-${XDG_CACHE_HOME:-$HOME/.cache}/omniloc}"; }

# In the project's folder: cargo's target folder for the programs of the Pi. Cargo does not see when what builds C code has
# changed: that is in the name.
cross_target() { echo "$(omniloc_cache)/cross-$(cat cross/* | sha256sum | cut -c 1-16)"; }

# QEMU's ARM machines and its disk images. Debian 12's own QEMU is older than its qemu-utils may be: both come from the
# backports, which apt is told of for this one installation.
ready_qemu_machine() {
    command -v qemu-system-aarch64 >/dev/null && command -v qemu-img >/dev/null && return
    if [ "$(. /etc/os-release && echo "${VERSION_CODENAME:-}")" != bookworm ] || [ "$(id -u)" -ne 0 ]; then
        install_packages qemu-system-arm qemu-utils
        return
    fi
    apt_folder=$(mktemp -d)
    mkdir -p "$apt_folder/lists/partial"
    # From where this machine has Debian itself.
    mirror=$(apt-get indextargets --format '$(REPO_URI)' 'Created-By: Packages' 'Codename: bookworm' | head -n 1)
    [ -n "$mirror" ] || give_up "apt knows no source of Debian 12: run apt-get update"
    {
        cat /etc/apt/sources.list 2>/dev/null || true
        echo "deb $mirror bookworm-backports main"
    } >"$apt_folder/sources.list"
    cat >"$apt_folder/apt.conf" <<CONFIGURATION
Dir::State::lists "$apt_folder/lists";
Dir::Etc::sourcelist "$apt_folder/sources.list";
CONFIGURATION
    APT_CONFIG=$apt_folder/apt.conf apt-get update --quiet >&2
    APT_CONFIG=$apt_folder/apt.conf DEBIAN_FRONTEND=noninteractive apt-get install --yes --quiet --no-install-recommends \
        --target-release bookworm-backports qemu-system-arm qemu-utils >&2
    rm -rf "$apt_folder"
}
