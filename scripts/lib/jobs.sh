# Sourced by scripts that start other programs: a signal that ends a script ends its child at once.
# shellcheck shell=bash

# Children run as jobs in their own process groups, so that a signal reaches this shell at once, and the shell can
# forward it in any state.
set -m
child=
interrupted=
on_signal() {
    interrupted=1
    [ -z "$child" ] || kill -TERM -- "-$child" 2>/dev/null
}
trap on_signal INT TERM HUP

# Run a command; its exit code is then in $code. After a signal and the command's end, exit with 130.
run() {
    [ -z "$interrupted" ] || exit 130
    "$@" </dev/null &
    child=$!
    [ -z "$interrupted" ] || kill -TERM -- "-$child" 2>/dev/null
    while true; do
        wait "$child" 2>/dev/null
        code=$?
        kill -0 "$child" 2>/dev/null || break
    done
    child=
    [ -z "$interrupted" ] || exit 130
}

# Set up the checkout with these extras if necessary, and enter its environment; $here is its folder of scripts.
enter() {
    run "$here/setup" --quiet "$@"
    [ "$code" = 0 ] || exit "$code"
    . "$here/env.sh" || exit 2
}

# Do the same, and make the modules in the folder tests importable.
enter_tests() {
    enter "$@"
    export PYTHONPATH="$here/../tests:$here/../tests/shared${PYTHONPATH:+:$PYTHONPATH}"
}
