# Sourced after jobs.sh: packages that not every part needs, on top of what scripts/setup has installed.
# shellcheck shell=bash

# Install requirements-$1.lock into the environment that env.sh has entered, unless it is there.
install_extra() {
    _install "$1" "$VIRTUAL_ENV/.needle-$1"
}

# Install requirements-$1.lock into the checkout's folder .$1, unless it is there: what does not go together with
# requirements.lock. Who wants it puts that folder first in PYTHONPATH.
install_beside() {
    local folder
    folder="$(dirname -- "$VIRTUAL_ENV")/.$1"
    ! cmp -s -- "$folder/../requirements-$1.lock" "$folder/.needle-$1" || return 0
    rm -rf -- "$folder"
    _install "$1" "$folder/.needle-$1" --target "$folder"
}

# Install requirements-$1.lock with pip's options $3.., unless stamp $2 says that it is there.
_install() {
    local lock stamp="$2"
    lock="$(dirname -- "$VIRTUAL_ENV")/requirements-$1.lock"
    ! cmp -s -- "$lock" "$stamp" || return 0
    echo "setup: installing the packages of requirements-$1.lock" >&2
    run python -m pip install --quiet --no-input --disable-pip-version-check --no-deps --no-build-isolation \
        --require-hashes "${@:3}" --requirement "$lock"
    if [ "$code" != 0 ]; then
        echo "setup: could not install the packages of requirements-$1.lock" >&2
        exit 2
    fi
    cp -- "$lock" "$stamp"
}
