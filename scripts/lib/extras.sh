# Sourced after jobs.sh: packages that not every part needs, on top of what scripts/setup has installed.
# shellcheck shell=bash

# Install requirements-$1.lock into the environment that env.sh has entered, unless it is there.
install_extra() {
    local lock stamp="$VIRTUAL_ENV/.needle-$1"
    lock="$(dirname -- "$VIRTUAL_ENV")/requirements-$1.lock"
    ! cmp -s -- "$lock" "$stamp" || return 0
    echo "setup: installing the packages of requirements-$1.lock" >&2
    run python -m pip install --quiet --no-input --disable-pip-version-check --no-deps --require-hashes \
        --requirement "$lock"
    if [ "$code" != 0 ]; then
        echo "setup: could not install the packages of requirements-$1.lock" >&2
        exit 2
    fi
    cp -- "$lock" "$stamp"
}
