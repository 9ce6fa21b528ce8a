# Sourced by the scripts that start others: a signal that ends a script ends what it runs, at once.
# shellcheck shell=bash

# Children run as jobs with process groups of their own, so that a signal reaches this shell at once and it can
# pass it on, whatever it is doing.
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

# Set the checkout up with these extras where that is not done, and enter its environment: $here is its folder of scripts.
enter() {
    run "$here/setup" --quiet "$@"
    [ "$code" = 0 ] || exit "$code"
    . "$here/env.sh" || exit 2
}

# Likewise, and what is in the folder tests can be imported, too.
enter_tests() {
    enter "$@"
    export PYTHONPATH="$here/../tests:$here/../tests/shared${PYTHONPATH:+:$PYTHONPATH}"
}
