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
