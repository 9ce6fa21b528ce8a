# Sourced after jobs.sh: packages that not every part needs, on top of what scripts/setup has installed.
# shellcheck shell=bash

# Install requirements-$1.lock into the environment that env.sh has entered, unless it is there.
install_extra() {
    local lock stamp="$VIRTUAL_ENV/.needle-$1"
    lock="$(dirname -- "$VIRTUAL_ENV")/requirements-$1.lock"
    ! cmp -s -- "$lock" "$stamp" || return 0
    _install "$1"
    cp -- "$lock" "$stamp"
}

# Install requirements-$1.lock into the checkout's folder .$1, unless it is there: what does not go together with
# requirements.lock. Who wants it puts that folder first in PYTHONPATH.
install_beside() {
    local root folder wanted
    root="$(dirname -- "$VIRTUAL_ENV")"
    folder="$root/.$1"
    wanted="$(python -V && cat -- "$root/requirements-$1.lock")"
    [ "$wanted" != "$(cat -- "$folder/.needle-$1" 2>/dev/null)" ] || return 0
    rm -rf -- "$folder"
    _install "$1" --target "$folder"
    printf '%s\n' "$wanted" >"$folder/.needle-$1"
}

# Install requirements-$1.lock with pip's options $2..
_install() {
    echo "setup: installing the packages of requirements-$1.lock" >&2
    run python -m pip install --quiet --no-input --disable-pip-version-check --no-deps --no-build-isolation \
        --require-hashes "${@:2}" --requirement "$(dirname -- "$VIRTUAL_ENV")/requirements-$1.lock"
    if [ "$code" != 0 ]; then
        echo "setup: could not install the packages of requirements-$1.lock" >&2
        exit 2
    fi
}
